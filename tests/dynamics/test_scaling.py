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
