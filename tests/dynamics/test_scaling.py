"""Scaling by block, constant columns, features of the horizon."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.preprocessing import (
    MaxAbsScaler,
    MinMaxScaler,
    QuantileTransformer,
    RobustScaler,
    StandardScaler,
)

from trajlearn import BlockScaler, HorizonFeatures
from trajlearn.trajectories._layout import Layout

LAYOUT = Layout(
    {
        "state": ("x", "y"),
        "action": ("a",),
        "horizon": ("horizon",),
        "params": ("k", "l"),
        "context": ("task=a", "task=b"),
    }
)


def rows(n=50, seed=0):
    rng = np.random.default_rng(seed)
    task = rng.integers(2, size=n)
    return np.column_stack(
        [rng.normal(3, 2, (n, 2)), rng.uniform(5, 9, (n, 4)), task == 0, task == 1]
    ).astype(float)


def test_each_block_gets_the_scaling_of_its_kind():
    X = rows()
    Z = BlockScaler().fit(X, layout=LAYOUT).transform(X)
    np.testing.assert_allclose(Z[:, :3].mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(Z[:, :3].std(axis=0), 1)
    np.testing.assert_allclose(Z[:, 3:6].min(axis=0), -1)
    np.testing.assert_allclose(Z[:, 3:6].max(axis=0), 1)
    np.testing.assert_array_equal(Z[:, 6:], X[:, 6:])


@pytest.mark.parametrize("slot", ["state", "action", "horizon", "params"])
@pytest.mark.parametrize(
    "transformer",
    [
        StandardScaler(with_mean=False),
        StandardScaler(with_std=False),
        MinMaxScaler((0, 5)),
        MinMaxScaler(clip=True),
        MaxAbsScaler(),
        RobustScaler(with_centering=False),
        RobustScaler(with_scaling=False),
        QuantileTransformer(n_quantiles=10),
        HorizonFeatures(n_scales=3),
        "passthrough",
    ],
    ids=str,
)
def test_a_slot_takes_any_transformer(slot, transformer):
    X, new = rows(), rows(9, seed=1) * 1.3
    scaler = BlockScaler(**{slot: transformer}).fit(X, layout=LAYOUT)
    where = LAYOUT[slot]
    expected = new[:, where]
    if transformer != "passthrough":
        expected = clone(transformer).fit(X[:, where]).transform(new[:, where])
    found = scaler.transform(new)[:, scaler.block_columns_[slot]]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    others = np.setdiff1d(np.arange(scaler.transform(new).shape[1]), scaler.block_columns_[slot])
    plain = BlockScaler().fit(X, layout=LAYOUT)
    kept = np.setdiff1d(np.arange(8), plain.block_columns_[slot])
    np.testing.assert_array_equal(scaler.transform(new)[:, others], plain.transform(new)[:, kept])


@pytest.mark.parametrize(
    ("value", "later"),
    [(1e8, 1.1e8), (-3.0, -3.3), (0.0, 0.1), (5e-9, 5.5e-9)],
)
def test_a_constant_column_that_later_changes_a_tenth_moves_a_tenth(value, later):
    X = np.column_stack([rows()[:, :2], np.full(50, value)])
    layout = Layout({"state": ("x", "y"), "params": ("k",)})
    scaler = BlockScaler().fit(X, layout=layout)
    new = X[:1].copy()
    new[0, 2] = later
    step = scaler.transform(new)[0, 2] - scaler.transform(X[:1])[0, 2]
    assert np.isclose(abs(step), 0.1)


def test_round_off_counts_as_constant():
    t = 0.02 * np.arange(1, 51)
    dt = (t + 0.02) - t
    assert np.ptp(dt) > 0
    X = np.column_stack([rows()[:, :2], dt])
    scaler = BlockScaler().fit(X, layout=Layout({"state": ("x", "y"), "dt": ("dt",)}))
    np.testing.assert_allclose(scaler.transform(X)[:, 2], 1.0)


def test_weights_count_as_repeated_rows():
    X = rows()
    weight = np.arange(50) % 4.0
    repeated = X[np.repeat(np.arange(50), weight.astype(int))]
    weighted = BlockScaler().fit(X[weight > 0], layout=LAYOUT, sample_weight=weight[weight > 0])
    np.testing.assert_allclose(
        weighted.transform(X), BlockScaler().fit(repeated, layout=LAYOUT).transform(X), atol=1e-10
    )


def test_without_a_layout_all_columns_are_states():
    X = rows()
    np.testing.assert_allclose(
        BlockScaler().fit_transform(X), StandardScaler().fit_transform(X), atol=1e-12
    )


def test_bad_slots_are_refused():
    with pytest.raises(ValueError, match="'state' parameter"):
        BlockScaler(state="standard").fit(rows())
    with pytest.raises(ValueError, match="'n_scales' parameter"):
        HorizonFeatures(n_scales=-1).fit(rows())


# -- bounds of params -----------------------------------------------------------------------

BOUNDS = [[4.0, 12.0], [-1.0, 0.0]]


def test_bounds_map_params_to_minus_1_and_1_whatever_the_data():
    X, ends = rows(), rows()[:2]
    X[:, 4] = 7.0  # one theta in the log: its column is constant
    ends[:, 4:6] = np.transpose(BOUNDS)
    scaler = BlockScaler(param_bounds=BOUNDS, features=error).fit(X, layout=LAYOUT)
    where = scaler.block_columns_["params"]
    np.testing.assert_allclose(scaler.transform(ends)[:, where], [[-1, -1], [1, 1]])
    np.testing.assert_allclose(scaler.transform(X)[:, where[0]], 2 * (7 - 4) / 8 - 1)
    plain = BlockScaler(features=error).fit(X, layout=LAYOUT)
    np.testing.assert_allclose(
        np.delete(scaler.transform(X), where, axis=1), np.delete(plain.transform(X), where, axis=1)
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"param_bounds": [[0, 1]]}, r"\(1, 2\), and the rows hold 2 params"),
        ({"param_bounds": [[0, 1], [2, 2]]}, "each lower bound below"),
        ({"param_bounds": [[0, 1], [2, np.inf]]}, "must be finite"),
        ({"param_bounds": [[1, 0], [0, 1]]}, "each lower bound below"),
        ({"param_bounds": BOUNDS, "params": MinMaxScaler()}, "give one"),
    ],
)
def test_bad_bounds_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        BlockScaler(**settings).fit(rows(), layout=LAYOUT)


def test_bounds_need_params():
    with pytest.raises(ValueError, match=r"hold 0 params.*among its inputs"):
        BlockScaler(param_bounds=BOUNDS).fit(rows()[:, :2], layout={"state": slice(0, 2)})


# -- features of state and params -----------------------------------------------------------


def error(states, params):
    """Two columns of unequal size, as a controller might compute them."""
    gain, target = params.T
    return np.column_stack([target - states[:, 1], 100 * gain * np.arctan2(*states.T)])


@pytest.mark.parametrize("horizon", [None, HorizonFeatures(n_scales=3)], ids=["affine", "not"])
def test_features_follow_all_blocks_with_mean_0_and_variance_1(horizon):
    X, new = rows(), rows(9, seed=1)
    plain = BlockScaler(horizon=horizon).fit(X, layout=LAYOUT)
    scaler = BlockScaler(horizon=horizon, features=error).fit(X, layout=LAYOUT)
    width = plain.transform(X).shape[1]
    assert scaler.block_columns_["features"].tolist() == [width, width + 1]
    np.testing.assert_array_equal(scaler.transform(new)[:, :width], plain.transform(new))
    of_unscaled = StandardScaler().fit(error(X[:, :2], X[:, 4:6]))
    np.testing.assert_allclose(
        scaler.transform(new)[:, width:],
        of_unscaled.transform(error(new[:, :2], new[:, 4:6])),
        rtol=1e-12,
        atol=1e-12,
    )
    assert (scaler.affine_ is None) == (horizon is not None)
    assert scaler.n_features_in_ == X.shape[1]


def test_weights_count_for_features_too():
    X, weight = rows(), 1 + np.arange(50) % 4
    repeated = BlockScaler(features=error).fit(np.repeat(X, weight, axis=0), layout=LAYOUT)
    weighted = BlockScaler(features=error).fit(X, layout=LAYOUT, sample_weight=weight.astype(float))
    np.testing.assert_allclose(weighted.transform(X), repeated.transform(X), atol=1e-10)


def test_a_constant_feature_is_divided_by_its_magnitude():
    def values(states, params):
        return np.where(states[:, :1] > 1e3, -4.4, -4.0)

    X = rows()
    scaler = BlockScaler(features=values).fit(X, layout=LAYOUT)
    np.testing.assert_allclose(scaler.transform(X)[:, -1], -1.0)
    np.testing.assert_allclose(scaler.transform(X + 1e4)[:, -1], -1.1)


@pytest.mark.parametrize("layout", [None, {"horizon": slice(0, 1), "state": slice(1, 8)}])
def test_without_params_features_get_none_of_them(layout):
    shapes = []

    def square(states, params):
        shapes.append((states.shape, params.shape))
        return states[:, -1:] ** 2

    X = rows()
    scaler = BlockScaler(features=square).fit(X, layout=layout)
    assert shapes == [((50, 8 if layout is None else 7), (50, 0))]
    expected = StandardScaler().fit_transform(X[:, -1:] ** 2)
    np.testing.assert_allclose(scaler.transform(X)[:, -1:], expected, atol=1e-12)


def test_features_may_overwrite_their_arguments():
    def careless(states, params):
        states -= params
        params[:] = 0
        return states

    X = rows()
    before = X.copy()
    careful = BlockScaler(features=lambda states, params: states - params)
    scaler = BlockScaler(features=careless).fit(X, layout=LAYOUT)
    np.testing.assert_array_equal(
        scaler.scaled(X), careful.fit(before, layout=LAYOUT).scaled(before)
    )
    np.testing.assert_array_equal(X, before)


@pytest.mark.parametrize("horizon", [None, HorizonFeatures(n_scales=3)], ids=["affine", "not"])
def test_a_row_with_features_has_the_same_bits_alone_and_in_a_batch(horizon):
    def waves(states, params):
        a, b = params.T[:, :, None]
        return np.hstack([np.sin(a * states), np.arctan2(b, states), np.exp(-a), np.sqrt(b)])

    X = rows(300)
    scaler = BlockScaler(horizon=horizon, features=waves).fit(X, layout=LAYOUT)
    batch = scaler.transform(X)
    for n in (1, 2, 3, 7, 8, 33, 128):
        parts = [scaler.transform(X[at : at + n]) for at in range(0, len(X), n)]
        np.testing.assert_array_equal(np.concatenate(parts), batch)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda s: s[:, 0], r"shape \(50,\) for states of shape \(50, 2\).*expected \(50, k\)"),
        (lambda s: s[:1], r"shape \(1, 2\)"),
        (lambda s: s[:, :0], r"shape \(50, 0\).*expected \(50, k\).*at least one column"),
        (lambda s: s.T, r"shape \(2, 50\)"),
        (lambda s: s[:, None], r"shape \(50, 1, 2\)"),
        (lambda s: None, r"shape \(\)"),
        (lambda s: s / (s[:, :1] != s[7, 0]), "NaN or infinite.*clipping"),
        (lambda s: np.where(s == s[7, 0], np.nan, s), "NaN or infinite.*clipping"),
    ],
    ids=["1-D", "one row", "no column", "transposed", "3-D", "nothing", "infinite", "NaN"],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_bad_features_are_refused_by_name(returned, message):
    def controller_error(states, params):
        return returned(states)

    with pytest.raises(ValueError, match=f"features=controller_error returned .*{message}"):
        BlockScaler(features=controller_error).fit(rows(), layout=LAYOUT)


def test_bad_features_are_refused_at_prediction_too():
    def logarithm(states, params):
        with np.errstate(invalid="ignore"):
            return np.log(states[:, :1])

    def by_number(states, params):
        return states[:, [0] * (1 if len(states) == 50 else 2)]

    X = np.abs(rows()) + 1
    far = X.copy()
    far[3, 0] = -5.0
    scaler = BlockScaler(features=logarithm).fit(X, layout=LAYOUT)
    with pytest.raises(ValueError, match=r"features=logarithm.* first for states \[-5\. "):
        scaler.scaled(far)
    scaler = BlockScaler(features=by_number).fit(X, layout=LAYOUT)
    with pytest.raises(ValueError, match=r"shape \(9, 2\).*expected \(9, 1\).*always as many"):
        scaler.scaled(X[:9])


def test_features_need_states():
    scaler = BlockScaler(features=error)
    with pytest.raises(
        ValueError, match=r"features=error .*no block 'state'.*\['params'\].*layout"
    ):
        scaler.fit(rows(), layout={"params": slice(0, 8)})
    with pytest.raises(ValueError, match="'features' parameter"):
        BlockScaler(features="error").fit(rows())


# -- features of the horizon ----------------------------------------------------------------


@given(
    longest=st.integers(2, 5000),
    dt=st.sampled_from([0.02, 1.0, 250.0]),
    n_scales=st.integers(0, 8),
)
def test_features_of_a_horizon_are_bounded_and_tell_horizons_apart(longest, dt, n_scales):
    h = dt * np.unique(np.geomspace(1, longest, 20).astype(int))[:, None]
    features = HorizonFeatures(n_scales=n_scales)
    F = features.fit(h).transform(h)
    assert F.shape == (len(h), 2 + n_scales)
    assert (np.abs(F) <= 1 + 1e-12).all()
    np.testing.assert_allclose(F[-1, :2], 1.0)
    assert (np.diff(F[:, :2], axis=0) > 0).all()
    assert (np.diff(F[:, 2:], axis=0) >= 0).all()
    if n_scales > 1:
        first = min(2 * h[0, 0], h[-1, 0])
        expected = np.geomspace(max(first, 2 * h[-1, 0] / 1000), h[-1, 0], n_scales)
        np.testing.assert_allclose(features.scales_[:, 0], expected)
    # any horizon is answered
    assert np.isfinite(features.transform([[0.0], [-3.0], [1e6 * dt]])).all()


def test_features_by_hand():
    features = HorizonFeatures(n_scales=1).fit([[1.0], [10.0]])
    F = features.transform([[4.0]])[0]
    log = 2 * np.arcsinh(4.0) / np.arcsinh(10.0) - 1
    np.testing.assert_allclose(F, [2 * 4 / 10 - 1, log, 1 - 2 * np.exp(-4 / 2.0)])
