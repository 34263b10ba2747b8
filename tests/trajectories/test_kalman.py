"""KalmanSmoother: against filterpy, known noise, no leak, and where it cannot help."""

import pickle
import warnings

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from scipy.signal import lfilter
from sklearn import config_context
from sklearn.base import clone
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline

from trajlearn.datasets import load_crazyflie_gains
from trajlearn.dynamics import OneStepRegressor, TrajectoryRegressor
from trajlearn.evaluation import cross_validate_horizons, horizon_scorer
from trajlearn.exceptions import MixedSamplingError, SmoothingWarning
from trajlearn.trajectories import TrajectoryDataset, _kalman_blocks
from trajlearn.trajectories._kalman_blocks import _chunks
from trajlearn.trajectories.kalman import KalmanSmoother, StateSpaceModel

DT = 0.05


def simulate(n=40, steps=100, *, order=1, density=2.0, irregular=False, seed=0):
    """Motions of the model: position, velocity (and acceleration) by episode, and times."""
    rng = np.random.default_rng(seed)
    dt = DT * (rng.uniform(0.5, 1.5, steps) if irregular else np.ones(steps))
    hidden = np.zeros((n, steps + 1, order + 1))
    hidden[:, 0] = rng.normal(size=(n, order + 1)) + 3.0 * (np.arange(order + 1) == 1)
    for t, step in enumerate(dt):
        root = np.linalg.cholesky(Q_continuous_white_noise(order + 1, step, density))
        noise = rng.normal(size=(n, order + 1)) @ root.T
        hidden[:, t + 1] = hidden[:, t] @ transition(step, order).T + noise
    return hidden, np.concatenate([[0.0], np.cumsum(dt)])


def transition(dt, order=1):
    return np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])[: order + 1, : order + 1]


def measure(hidden, times, sigma, seed=1, **fields):
    """Noisy positions (and velocities, for two sigmas) as a dataset."""
    noise = np.random.default_rng(seed).normal(size=(*hidden.shape[:2], len(sigma)))
    states = hidden[..., : len(sigma)] + sigma * noise
    names = ["x", "v"][: len(sigma)]
    return TrajectoryDataset.from_arrays(
        states, times=np.tile(times, (len(states), 1)), state_names=names, **fields
    )


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


@pytest.fixture(scope="module")
def tracks():
    hidden, times = simulate(irregular=True)
    return hidden, measure(hidden, times, [0.03])


@pytest.fixture(scope="module")
def controlled():
    """A damped oscillator pushed by logged actions, with noisy positions and velocities."""
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(24, 60, 1)).repeat(4, axis=1)[:, :60]
    states = np.zeros((24, 61, 2))
    states[:, 0] = rng.normal(size=(24, 2))
    for t in range(60):
        x, v = states[:, t].T
        states[:, t + 1, 0] = x + DT * v
        states[:, t + 1, 1] = v + DT * (-2 * x - 0.5 * v + actions[:, t, 0])
    noisy = states + 0.02 * rng.normal(size=states.shape)
    return TrajectoryDataset.from_arrays(noisy, actions=actions, dt=DT, state_names=["x", "v"])


# -- against filterpy -------------------------------------------------------------------------


def reference(smoother, key, values, times, measurement, sigma, order):
    """Filtered and smoothed hidden states by filterpy, one episode."""
    size = order + 1
    filter_ = KalmanFilter(dim_x=size, dim_z=len(measurement))
    first = np.append(values[0], np.zeros(size - len(measurement)))
    filter_.x = (first + smoother.initial_mean_[key])[:, None]
    filter_.P = smoother.initial_covariance_[key].copy()
    filter_.H, filter_.R = measurement, np.diag(np.square(sigma))
    density = smoother.process_noise_[key]
    steps = np.diff(times)
    f = [np.eye(size), *(transition(step, order) for step in steps)]
    q = [np.zeros((size, size))]
    q += [Q_continuous_white_noise(size, step, density) for step in steps]
    # the first measurement is where it begins
    later = [None, *values[1:, :, None]]
    means, covariances, _, _ = filter_.batch_filter(later, Fs=f, Qs=q)
    return means[..., 0], filter_.rts_smoother(means, covariances, f, q)[0][..., 0]


@pytest.mark.parametrize(("model", "order"), [("velocity", 1), ("acceleration", 2)])
def test_filter_and_smoother_agree_with_filterpy(tracks, model, order):
    ds = tracks[1]
    smoother = KalmanSmoother(model, append_velocities=True)
    smooth = smoother.fit_transform(ds)
    sigma = [smoother.measurement_noise_["x"]]
    expected = reference(
        smoother, "x", ds[3].states, ds[3].times, np.eye(1, order + 1), sigma, order
    )
    np.testing.assert_allclose(smoother.transform(ds)[3].states, expected[0][:, :2], atol=1e-9)
    np.testing.assert_allclose(smooth[3].states, expected[1][:, :2], atol=1e-9)


@pytest.mark.parametrize(("model", "order"), [("velocity", 1), ("acceleration", 2)])
def test_a_measured_velocity_joins_the_filter(model, order):
    hidden, times = simulate(n=12, steps=40, order=order, irregular=True)
    ds = measure(hidden, times, [0.05, 0.3])
    smoother = KalmanSmoother(model, velocities={"x": "v"})
    smooth = smoother.fit_transform(ds)
    sigma = [smoother.measurement_noise_[name] for name in "xv"]
    expected = reference(
        smoother, "x", ds[5].states, ds[5].times, np.eye(2, order + 1), sigma, order
    )
    np.testing.assert_allclose(smoother.transform(ds)[5].states, expected[0][:, :2], atol=1e-9)
    np.testing.assert_allclose(smooth[5].states, expected[1][:, :2], atol=1e-9)


def test_a_given_model_agrees_with_filterpy():
    hidden, times = simulate(n=8, steps=30)
    h = np.array([[1.0, 0.2], [0.0, 1.0]])
    ds = measure(hidden @ h.T, times, [0.1, 0.3])
    r = np.array([[0.01, 0.02], [0.02, 0.09]])
    q = Q_continuous_white_noise(2, DT, 2.0)
    model = StateSpaceModel(transition(DT), h, q, r, [0.0, 1.0], np.diag([1.0, 2.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the model is right
        smooth = KalmanSmoother(model).fit_transform(ds)
    filter_ = KalmanFilter(dim_x=2, dim_z=2)
    filter_.x, filter_.P = np.array([[0.0], [1.0]]), np.diag([1.0, 2.0])
    filter_.H, filter_.R = h, r
    f, q = [np.eye(2), *[transition(DT)] * 30], [np.zeros((2, 2)), *[q] * 30]
    means, covariances, _, _ = filter_.batch_filter(list(ds[1].states[..., None]), Fs=f, Qs=q)
    expected = filter_.rts_smoother(means, covariances, f, q)[0][..., 0] @ h.T
    np.testing.assert_allclose(smooth[1].states, expected, atol=1e-9)


def test_episodes_of_very_different_lengths_take_little_memory():
    counts = [51] * 300 + [20_001] + [52] * 20
    rng = np.random.default_rng(0)
    ds = TrajectoryDataset.from_arrays([rng.normal(size=(n, 1)) for n in counts])
    grids = list(_chunks(ds))
    # not the 6.4 million of one grid
    assert sum(grid.rows.size for grid in grids) < 1.05 * sum(counts)
    assert max(grid.rows.size for grid in grids) <= 2**16
    rows = np.concatenate([grid.rows[grid.known] for grid in grids])
    np.testing.assert_array_equal(np.sort(rows), np.arange(sum(counts)))


def test_chunks_do_not_change_the_bits(tracks, monkeypatch):
    smoother = KalmanSmoother()
    whole = smoother.fit_transform(tracks[1])
    past = smoother.transform(tracks[1])
    monkeypatch.setattr(_kalman_blocks, "_CELLS", 700)
    assert len(list(_chunks(tracks[1]))) > 5
    assert smoother.fit_transform(tracks[1]) == whole
    assert smoother.transform(tracks[1]) == past


def test_episodes_of_any_length_are_smoothed_as_if_alone():
    hidden, _ = simulate(n=9, steps=50)
    steps = [50, 3, 20, 1, 50, 7, 33, 2, 12]
    ds = TrajectoryDataset.from_arrays([h[: t + 1, :1] for h, t in zip(hidden, steps)], dt=DT)
    model = StateSpaceModel(
        transition(DT), [[1.0, 0.0]], 0.1 * np.eye(2), [[0.01]], [0.0, 1.0], np.eye(2)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        together = KalmanSmoother(model).fit_transform(ds)
        for i in range(9):
            alone = KalmanSmoother(model).fit_transform(ds[[i]])
            np.testing.assert_allclose(together[i].states, alone.states, atol=1e-12)


# -- noise by maximum likelihood --------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "order", "sigma"),
    [("velocity", 1, 0.03), ("velocity", 1, 0.3), ("acceleration", 2, 0.05)],
)
def test_noise_is_recovered(model, order, sigma):
    hidden, times = simulate(n=60, order=order)
    smoother = KalmanSmoother(model).fit(measure(hidden, times, [sigma]))
    assert smoother.measurement_noise_["x"] == pytest.approx(sigma, rel=0.06)
    assert smoother.process_noise_["x"] == pytest.approx(2.0, rel=0.25)


def test_noise_of_positions_and_velocities_is_recovered():
    hidden, times = simulate(n=60)
    smoother = KalmanSmoother(velocities={"x": "v"}).fit(measure(hidden, times, [0.03, 0.2]))
    assert smoother.measurement_noise_["x"] == pytest.approx(0.03, rel=0.06)
    assert smoother.measurement_noise_["v"] == pytest.approx(0.2, rel=0.06)
    assert smoother.process_noise_["x"] == pytest.approx(2.0, rel=0.2)


def test_units_do_not_matter(tracks):
    ds = tracks[1]
    times = [1e-3 * episode.times for episode in ds]
    other = TrajectoryDataset.from_arrays(
        [1e6 * e.states for e in ds], times=times, state_names=["x"]
    )
    here, there = KalmanSmoother().fit(ds), KalmanSmoother().fit(other)
    assert there.measurement_noise_["x"] == pytest.approx(1e6 * here.measurement_noise_["x"], 1e-3)
    expected = 1e12 * 1e9 * here.process_noise_["x"]
    assert there.process_noise_["x"] == pytest.approx(expected, rel=1e-2)


def test_long_episodes_are_fitted_in_stretches():
    hidden, times = simulate(n=2, steps=3000)
    smoother = KalmanSmoother().fit(measure(hidden, times, [0.05]))
    assert smoother.measurement_noise_["x"] == pytest.approx(0.05, rel=0.06)


def test_the_likelier_model_is_chosen():
    for order, name in ((1, "velocity"), (2, "acceleration")):
        hidden, times = simulate(order=order, density=10.0)
        smoother = KalmanSmoother("auto").fit(measure(hidden, times, [0.05]))
        assert smoother.models_ == {"x": name}


def test_filters_of_several_models_stand_side_by_side():
    """Different orders, and a pair: each as if alone, in its own column."""
    (slow, _), (fast, _), (pair, _) = (
        simulate(n=16, steps=60, order=order, density=10.0, seed=seed)
        for seed, order in enumerate((2, 1, 1))
    )
    rng = np.random.default_rng(4)
    true = np.stack([pair[..., 1], slow[..., 0], fast[..., 0], pair[..., 0]], axis=2)
    noise = np.array([0.2, 0.05, 0.1, 0.03])
    ds = TrajectoryDataset.from_arrays(
        true + noise * rng.normal(size=true.shape), dt=DT, state_names=["v", "slow", "fast", "x"]
    )
    how = {"model": "auto", "velocities": {"x": "v"}, "append_velocities": True}
    smoother = KalmanSmoother(**how)
    smooth, past = smoother.fit_transform(ds), smoother.transform(ds)
    assert smoother.models_ == {"slow": "acceleration", "fast": "velocity", "x": "velocity"}
    assert smooth.state_names == ("v", "slow", "fast", "x", "d_slow", "d_fast")
    estimated = [smoother.measurement_noise_[name] for name in ds.state_names]
    np.testing.assert_allclose(estimated, noise, rtol=0.15)
    for names in (["slow"], ["fast"], ["x", "v"]):
        pairs = {"x": "v"} if len(names) > 1 else None
        alone = KalmanSmoother("auto", velocities=pairs, append_velocities=not pairs)
        part = ds.select_states(names)
        smooth_part = alone.fit_transform(part)
        wanted = smooth_part.state_names
        assert smooth.select_states(wanted).states == pytest.approx(smooth_part.states, abs=1e-9)
        now = past.select_states(wanted).states
        assert now == pytest.approx(alone.transform(part).states, abs=1e-9)


def test_given_noise_is_kept(tracks):
    ds = tracks[1]
    both = KalmanSmoother(measurement_noise=0.1, process_noise={"x": 3.0}).fit(ds)
    assert both.measurement_noise_["x"] == pytest.approx(0.1, rel=1e-12)
    assert both.process_noise_ == {"x": 3.0}
    density = KalmanSmoother(measurement_noise={"x": 0.03}).fit(ds).process_noise_["x"]
    assert density == pytest.approx(2.0, rel=0.2)
    sigma = KalmanSmoother(process_noise=2.0).fit(ds).measurement_noise_["x"]
    assert sigma == pytest.approx(0.03, rel=0.06)
    # more noise, more smoothing
    plain = KalmanSmoother().fit(ds)
    near, far = (rms(k.transform(ds).states - ds.states) for k in (plain, both))
    assert far > 1.5 * near


def test_violent_moments_are_not_taken_for_noise():
    """A jump at the start would be explained by noise, were the likelihood alone to decide."""
    rng = np.random.default_rng(0)
    t = np.arange(120)
    jumps = rng.normal(size=(40, 1)) * 5 * (0.4**t) + 0.01 * rng.normal(size=(40, 120))
    ds = TrajectoryDataset.from_arrays(jumps[..., None], dt=DT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        smoother = KalmanSmoother("acceleration").fit(ds)
    assert smoother.measurement_noise_["s0"] == pytest.approx(0.01, rel=0.1)


# -- what it is for ---------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["velocity", "acceleration"])
def test_states_come_closer_to_the_truth(tracks, model):
    hidden, ds = tracks
    true = hidden.reshape(-1, 2)
    smoother = KalmanSmoother(model, append_velocities=True)
    smooth, past = smoother.fit_transform(ds), smoother.transform(ds)
    raw = rms(ds.states - true[:, :1])[0]
    by_filter, by_smoother = (rms(x.states - true) for x in (past, smooth))
    assert by_filter[0] < 0.9 * raw
    assert by_smoother[0] < 0.65 * raw
    # velocities of unmeasured states, better than by differences (1.0)
    assert by_filter[1] < 0.5
    assert by_smoother[1] < 0.3


def test_measured_velocities_help_positions(tracks):
    hidden, times = simulate(irregular=True)
    ds, true = measure(hidden, times, [0.05, 0.1]), hidden.reshape(-1, 2)
    alone = KalmanSmoother().fit_transform(ds).states
    together = KalmanSmoother(velocities={"x": "v"}).fit_transform(ds).states
    assert (rms(together - true) < 0.8 * rms(alone - true)).all()


def test_first_velocity_is_the_mean_of_training(tracks):
    hidden, ds = tracks
    smoother = KalmanSmoother(append_velocities=True).fit(ds)
    first = smoother.transform(ds).states[ds.offsets[:-1]]
    np.testing.assert_allclose(first[:, 0], ds.states[ds.offsets[:-1], 0])
    np.testing.assert_allclose(first[:, 1], smoother.initial_mean_["x"][1])
    assert first[0, 1] == pytest.approx(3.0, abs=0.5)
    variance, off = smoother.initial_covariance_["x"], hidden[..., 1] - first[0, 1]
    assert variance[1, 1] == pytest.approx(np.mean(off**2), rel=0.2)
    assert variance[0, 0] == pytest.approx(smoother.measurement_noise_["x"] ** 2)


def test_few_episodes_leave_the_first_velocity_open():
    hidden, times = simulate(n=2)
    ds = measure(hidden, times, [0.03])
    smoother = KalmanSmoother(append_velocities=True).fit(ds)
    assert smoother.initial_covariance_["x"][1, 1] > 1e6
    two = smoother.transform(ds).states[[0, 1]]
    assert two[1, 1] == pytest.approx((two[1, 0] - two[0, 0]) / DT, rel=1e-3)


STARTS = {
    "velocity": ({}, 0.1),
    "acceleration": ({"model": "acceleration"}, 0.1),
    "pair": ({"velocities": {"x": "v"}}, 0.1),
}


@pytest.mark.parametrize("choice", STARTS)
@pytest.mark.parametrize("moved", [0.0, 10.0], ids=["windows", "elsewhere"])
def test_an_episode_may_begin_where_none_in_training_did(choice, moved):
    """Training episodes begin at rest in one place."""
    parameters, sigma = STARTS[choice]
    hidden, times = simulate(n=40, order=2, density=10.0)
    hidden = hidden - hidden[:, :1]
    hidden[..., 0] -= hidden[:, :1, 1] * times  # as the velocities
    ds = measure(hidden[..., :2], times, [sigma, sigma])
    if choice != "pair":
        ds = ds.select_states(["x"])
    smoother = KalmanSmoother(**parameters).fit(ds)
    offset = np.array([moved, 0.0])[: ds.states.shape[1]]
    true = hidden[..., : len(offset)] + offset
    seen = TrajectoryDataset.from_arrays(
        ds.states.reshape(true.shape) + offset, dt=DT, state_names=ds.state_names
    ).window(20)
    true = TrajectoryDataset.from_arrays(true, dt=DT).window(20)
    found = smoother.transform(seen)
    for step in (0, 1, 2, 5):
        rows = seen.offsets[:-1] + step
        raw, now = (rms(x.states[rows] - true.states[rows]) for x in (seen, found))
        assert (now <= 1.05 * raw).all()


def test_forecasts_of_windows_are_no_worse_than_raw():
    rng = np.random.default_rng(0)

    def cart(n):
        """At rest at 0, then pushed by known actions."""
        actions = rng.normal(size=(n, 20, 1)).repeat(5, axis=1)
        states = np.zeros((n, 101, 2))
        for t in range(100):
            states[:, t + 1, 0] = states[:, t, 0] + DT * states[:, t, 1]
            states[:, t + 1, 1] = states[:, t, 1] + DT * 2 * actions[:, t, 0]
        noisy = states + 0.02 * rng.normal(size=states.shape)
        how = {"actions": actions, "dt": DT, "state_names": ["x", "v"]}
        return tuple(TrajectoryDataset.from_arrays(s, **how) for s in (noisy, states))

    train, (seen, true) = cart(40)[0], (ds.window(25) for ds in cart(20))
    truth = true.states[true.offsets[:-1] + 1]
    smoother = KalmanSmoother(velocities={"x": "v"})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        errors = [
            rms(model.fit(train).predict(seen, horizon=1).mean[:, 0] - truth)
            for model in (
                OneStepRegressor(LinearRegression()),
                make_pipeline(smoother, OneStepRegressor(LinearRegression())),
            )
        ]
    assert (errors[1] <= 1.03 * errors[0]).all()


# -- the transformed dataset ------------------------------------------------------------------


@pytest.fixture(scope="module")
def mixed():
    """x, w, v (the velocity of x), u, with actions, params and groups."""
    hidden, times = simulate(n=20, steps=40)
    rng = np.random.default_rng(3)
    noisy = hidden[:, :, [0, 0, 1, 0]] * [1.0, 2.0, 1.0, 5.0]
    noisy = noisy + rng.normal(size=noisy.shape) * [0.05, 0.1, 0.3, 0.2]
    return TrajectoryDataset.from_arrays(
        noisy,
        times=np.tile(times, (20, 1)),
        actions=rng.normal(size=(20, 40, 1)),
        params=rng.normal(size=(20, 2)),
        group=np.arange(20) // 2,
        state_names=["x", "w", "v", "u"],
    )


def test_columns_stay_in_their_order_and_new_ones_follow(mixed):
    smoother = KalmanSmoother(velocities={"x": "v"}, append_velocities=["u", "w"])
    smooth = smoother.fit_transform(mixed)
    assert smooth.state_names == ("x", "w", "v", "u", "d_w", "d_u")
    assert smoother.get_feature_names_out().tolist() == list(smooth.state_names)
    assert (rms(smooth.states[:, :4] - mixed.states) < [0.1, 0.2, 0.6, 0.4]).all()
    v = smooth.states[:, 2]
    assert np.corrcoef(smooth.states[:, 4], v)[0, 1] > 0.9
    assert np.corrcoef(smooth.states[:, 5], v)[0, 1] > 0.9
    for name in ("times", "actions", "params", "group", "ids"):
        np.testing.assert_array_equal(getattr(smooth, name), getattr(mixed, name))


def test_raw_states_are_kept(mixed):
    smoother = KalmanSmoother()
    for result in (smoother.fit_transform(mixed), smoother.transform(mixed)):
        np.testing.assert_array_equal(result.observed, mixed.states)
        assert result.observed_names == mixed.state_names
        again = KalmanSmoother(measurement_noise=0.1).fit(result).transform(result)
        np.testing.assert_array_equal(again.observed, mixed.states)


def test_all_velocities_are_appended_that_are_not_measured(mixed):
    out = KalmanSmoother(velocities={"x": "v"}, append_velocities=True).fit_transform(mixed)
    assert out.state_names == ("x", "w", "v", "u", "d_w", "d_u")


def test_other_states_pass_through(mixed):
    out = KalmanSmoother(states=["u"]).fit_transform(mixed)
    np.testing.assert_array_equal(out.states[:, :3], mixed.states[:, :3])
    assert not np.array_equal(out.states[:, 3], mixed.states[:, 3])


def test_a_list_of_trajectories_will_do(mixed):
    episodes = list(mixed)
    smoother = KalmanSmoother().fit(episodes)
    assert smoother.transform(episodes) == smoother.transform(TrajectoryDataset(episodes))


# -- no leak ----------------------------------------------------------------------------------

MODELS = {
    "velocity": {"append_velocities": True},
    "acceleration": {"model": "acceleration"},
    "pair": {"velocities": {"x": "v"}},
    "given": {
        "model": StateSpaceModel(
            lambda dt: [[1, dt], [0, 1]],
            np.eye(2),
            lambda dt: Q_continuous_white_noise(2, dt, 1.0),
            [[0.01, 0.002], [0.002, 0.04]],
        )
    },
}


@pytest.mark.parametrize("choice", MODELS)
def test_no_estimate_changes_with_the_future_or_its_neighbours(choice):
    rng = np.random.default_rng(0)
    lengths = rng.integers(3, 60, 30)
    states = [np.cumsum(rng.normal(size=(n, 2)), axis=0) for n in lengths]
    times = [np.cumsum(rng.uniform(0.5, 1.5, n)) for n in lengths]
    ds = TrajectoryDataset.from_arrays(states, times=times, state_names=["x", "v"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        smoother = KalmanSmoother(**MODELS[choice]).fit(ds[:20])
    together = smoother.transform(ds)
    for i in range(0, 30, 3):
        alone = smoother.transform(ds[[i]])
        np.testing.assert_array_equal(alone.states, together[i].states)
        k = lengths[i] // 2
        garbage = states[i].copy()
        garbage[k + 1 :] = 1e6 * rng.normal(size=garbage[k + 1 :].shape)
        other = TrajectoryDataset.from_arrays(
            [states[(i + 1) % 30], garbage],
            times=[times[(i + 1) % 30], times[i]],
            state_names=["x", "v"],
        )
        seen = smoother.transform(other)[1].states
        np.testing.assert_array_equal(seen[: k + 1], together[i].states[: k + 1])
        assert not np.array_equal(seen[k + 1 :], together[i].states[k + 1 :])


@pytest.mark.parametrize("start", [0, 7])
def test_forecasts_of_a_pipeline_do_not_see_the_future(controlled, start):
    pipeline = make_pipeline(
        KalmanSmoother(velocities={"x": "v"}), OneStepRegressor(LinearRegression())
    ).fit(controlled)
    states = [episode.states.copy() for episode in controlled]
    for i, values in enumerate(states):
        values[start + 1 :] = 1e5 * (-1) ** i
    changed = TrajectoryDataset.from_arrays(
        states,
        actions=[e.actions for e in controlled],
        times=[e.times for e in controlled],
        state_names=["x", "v"],
    )
    expected = pipeline.predict(controlled, start=start)
    np.testing.assert_array_equal(pipeline.predict(changed, start=start).mean, expected.mean)
    np.testing.assert_array_equal(
        expected.initial_states,
        pipeline[0].transform(controlled).states[controlled.state_rows(start)],
    )


def test_smoothed_states_are_marked(controlled):
    smoother = KalmanSmoother(velocities={"x": "v"})
    smooth = smoother.fit_transform(controlled)
    assert smooth.hindsight
    assert smoother.transform(smooth).hindsight
    assert not smoother.transform(controlled).hindsight
    assert not controlled.hindsight


def test_forecasts_from_smoothed_states_warn(controlled):
    smoother = KalmanSmoother(velocities={"x": "v"})
    smooth = smoother.fit_transform(controlled)
    model = OneStepRegressor(LinearRegression()).fit(smooth)
    for forecast in (model.predict, model.forecast, model.score):
        with pytest.warns(SmoothingWarning, match="a start has seen what follows"):
            forecast(smooth)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(smoother.transform(controlled))
        model.predict(controlled)


def test_training_relative_to_a_model_does_not_warn(controlled):
    """The baseline is predicted for training targets."""
    gains = np.random.default_rng(0).normal(size=(24, 1))
    smooth = KalmanSmoother(velocities={"x": "v"}).fit_transform(controlled.assign(params=gains))
    baseline = OneStepRegressor(LinearRegression(), inputs="params")
    model = TrajectoryRegressor(LinearRegression(), baseline=baseline)
    with warnings.catch_warnings():
        warnings.simplefilter("error", SmoothingWarning)
        model.fit(smooth)
    with pytest.warns(SmoothingWarning, match="a start has seen") as caught:
        model.predict(smooth)
    assert len(caught) == 1


def test_training_states_may_be_filtered(mixed):
    smoother = KalmanSmoother(training="filter", append_velocities=True)
    filtered = smoother.fit_transform(mixed)
    assert filtered == KalmanSmoother(append_velocities=True).fit(mixed).transform(mixed)
    assert not filtered.hindsight
    assert filtered != clone(smoother).set_params(training="smooth").fit_transform(mixed)


# -- in scikit-learn --------------------------------------------------------------------------


def test_pipeline_learns_from_smoothed_and_scores_against_observed(controlled):
    smoother = KalmanSmoother(velocities={"x": "v"})
    pipeline = make_pipeline(smoother, OneStepRegressor(LinearRegression())).fit(controlled)
    model = OneStepRegressor(LinearRegression()).fit(clone(smoother).fit_transform(controlled))
    past = pipeline[0].transform(controlled)
    np.testing.assert_array_equal(pipeline.predict(controlled).mean, model.predict(past).mean)
    squared = model.predict(past).squared_errors(controlled)
    assert pipeline.score(controlled) == pytest.approx(-squared.mean())


def test_cross_validation_by_horizon(controlled):
    pipeline = make_pipeline(
        KalmanSmoother(append_velocities=True), OneStepRegressor(LinearRegression())
    )
    table = cross_validate_horizons(pipeline, controlled, [1, 20], cv=3)
    assert np.isfinite(table["median"]).all()
    assert (table["median"] < 0.05).all()


def test_grid_search(controlled):
    search = GridSearchCV(
        make_pipeline(KalmanSmoother(), OneStepRegressor(LinearRegression())),
        {"kalmansmoother__model": ["velocity"], "kalmansmoother__training": ["smooth", "filter"]},
        scoring=horizon_scorer(5),
        cv=3,
        error_score="raise",
    ).fit(controlled)
    scores = search.cv_results_["mean_test_score"]
    assert np.isfinite(scores).all()
    assert scores[0] != scores[1]


def test_clone_parameters_and_pickle(mixed):
    smoother = KalmanSmoother("acceleration", states=["x"], measurement_noise={"x": 0.1})
    again = clone(smoother).set_params(model="velocity")
    assert again.get_params()["states"] == ["x"]
    assert "KalmanSmoother(" in repr(smoother)
    fitted = smoother.fit(mixed)
    copied = pickle.loads(pickle.dumps(fitted))
    assert copied.transform(mixed) == fitted.transform(mixed)
    given = KalmanSmoother(StateSpaceModel(np.eye(1), np.eye(1), np.eye(1)), states=["x"])
    assert clone(given).get_params()["model"].H.shape == (1, 1)


def test_output_settings_leave_the_dataset_alone(mixed):
    smoother = KalmanSmoother()
    with config_context(transform_output="pandas"):
        assert isinstance(smoother.fit_transform(mixed), TrajectoryDataset)
        assert isinstance(smoother.transform(mixed), TrajectoryDataset)


def test_same_bits_every_time(mixed):
    a, b = KalmanSmoother("auto"), KalmanSmoother("auto")
    assert a.fit_transform(mixed) == b.fit_transform(mixed)


# -- a given model ----------------------------------------------------------------------------


def test_given_model_without_noise_is_fitted():
    hidden, times = simulate(n=60, irregular=True)
    model = StateSpaceModel(
        transition,
        [[1.0, 0.0]],
        lambda dt: Q_continuous_white_noise(2, dt, 1.0),
        outputs={"speed": [0.0, 1.0]},
    )
    ds = measure(hidden, times, [0.05])
    smoother = KalmanSmoother(model)
    smooth = smoother.fit_transform(ds)
    assert smooth.state_names == ("x", "speed")
    # Q is that of density 1, the truth is 2
    assert smoother.process_noise_["model"] == pytest.approx(2.0, rel=0.25)
    assert smoother.measurement_noise_["x"] == pytest.approx(0.05, rel=0.06)
    same = KalmanSmoother(append_velocities=True).fit_transform(ds)
    np.testing.assert_allclose(smooth.states, same.states, atol=2e-2)


def test_given_noise_of_a_given_model():
    hidden, times = simulate(n=10)
    model = StateSpaceModel(transition(DT), [[1.0, 0.0]], Q_continuous_white_noise(2, DT, 1.0))
    smoother = KalmanSmoother(model, measurement_noise=0.1, process_noise=2.0)
    smoother.fit(measure(hidden, times, [0.05]))
    assert smoother.measurement_noise_ == {"x": pytest.approx(0.1)}
    assert smoother.process_noise_ == {"model": 2.0}


def test_one_matrix_is_for_one_time_step():
    hidden, times = simulate(n=10)
    model = StateSpaceModel(transition(DT), [[1.0, 0.0]], 0.01 * np.eye(2), [[0.01]])
    smoother = KalmanSmoother(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        smoother.fit(measure(hidden, times, [0.05]))
    with pytest.raises(MixedSamplingError, match=r"time step 0\.05, but episode 0"):
        smoother.transform(measure(hidden, 2 * times, [0.05]))
    hidden, times = simulate(n=10, irregular=True)
    with pytest.raises(MixedSamplingError, match="functions of the time"):
        clone(smoother).fit_transform(measure(hidden, times, [0.05]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"H": np.eye(2)}, "H has 2 rows, but 1 states"),
        ({"F": np.eye(3)}, r"F of the model has shape \(3, 3\)"),
        ({"Q": -np.eye(2)}, "Q of the model is no covariance"),
        ({"R": [[0.0]]}, "R of the model must be positive definite"),
        ({"F": [[np.nan, 0], [0, 1]]}, "F of the model has NaN"),
        ({"initial_mean": [0.0, 0.0]}, "both initial_mean and initial_covariance"),
        ({"outputs": {"v": [1.0]}}, "output 'v' of the model needs 2 numbers"),
    ],
)
def test_matrices_have_to_fit(tracks, changes, message):
    given = {"F": np.eye(2), "H": [[1.0, 0.0]], "Q": np.eye(2), "R": [[1.0]]} | changes
    with pytest.raises(ValueError, match=message):
        KalmanSmoother(StateSpaceModel(**given)).fit(tracks[1])


def test_a_given_model_says_itself_what_is_measured(tracks):
    model = StateSpaceModel(np.eye(2), [[1.0, 0.0]], np.eye(2), [[1.0]])
    with pytest.raises(ValueError, match="go with a model by name"):
        KalmanSmoother(model, append_velocities=True).fit(tracks[1])
    with pytest.raises(ValueError, match="has Q and R"):
        KalmanSmoother(model, measurement_noise=0.1).fit(tracks[1])


# -- where it cannot help ---------------------------------------------------------------------


def test_filtered_logs_are_told(tracks):
    hidden, ds = tracks
    smooth = KalmanSmoother().fit_transform(ds)
    # what an on-board filter leaves in the log
    logged = TrajectoryDataset.from_arrays(
        [e.states for e in smooth], times=[e.times for e in ds], state_names=["x"]
    )
    with pytest.warns(SmoothingWarning, match=r"noise is far below the change .* in x \("):
        KalmanSmoother("acceleration").fit(logged)
    clean = measure(hidden, ds[0].times, [0.0])
    with pytest.warns(SmoothingWarning, match="far below"):
        KalmanSmoother().fit(clean)


def test_noisy_logs_are_not(tracks, mixed):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        KalmanSmoother().fit(tracks[1])
        KalmanSmoother(velocities={"x": "v"}).fit(mixed)


@pytest.mark.parametrize(
    "spoil",
    [lambda v: -v, lambda v: 0.8 * v, lambda v: v + 0.5],
    ids=["sign", "scale", "offset"],
)
def test_contradicting_velocities_are_told(spoil):
    hidden, times = simulate(n=20, steps=60)
    ds = measure(hidden, times, [0.02, 0.05])
    states = ds.states.copy()
    states[:, 1] = spoil(states[:, 1])
    ds = TrajectoryDataset.from_arrays(states.reshape(20, -1, 2), dt=DT, state_names=["x", "v"])
    assert "contradict" in told(ds, velocities={"x": "v"})


def told(ds, **parameters):
    """Messages of the warnings of a fit."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        KalmanSmoother(**parameters).fit(ds)
    return " ".join(str(item.message) for item in caught)


def test_velocities_of_the_step_before_do_not_contradict():
    """Positions of an explicit Euler step are no contradiction, only coarse."""
    t = np.arange(300)
    phase = np.random.default_rng(0).uniform(0, 6, (20, 1))
    v = np.sin(0.4 * t + phase)
    x = np.cumsum(np.concatenate([0 * phase, 0.1 * v[:, :-1]], axis=1), axis=1)
    ds = TrajectoryDataset.from_arrays(np.stack([x, v], axis=2), dt=0.1, state_names=["x", "v"])
    assert "contradict" not in told(ds, velocities={"x": "v"})


def test_noise_does_not_contradict():
    ds = measure(np.zeros((20, 101, 2)), DT * np.arange(101), [0.5, 2.0])
    assert "contradict" not in told(ds, velocities={"x": "v"})


def test_resolution_is_not_taken_for_exactness():
    """At rest a coarse sensor gives the same number again and again."""
    speed = np.random.default_rng(0).uniform(0.5, 1.5, (20, 1))
    moved = np.maximum(speed * (np.arange(150) - 100) * DT, 0)
    ds = TrajectoryDataset.from_arrays((0.1 * np.round(moved / 0.1))[..., None], dt=DT)
    assert "far below" not in told(ds)


def ema(values, alpha):
    return lfilter([alpha], [1, alpha - 1], values, axis=1)


@pytest.mark.parametrize("kind", ["moving average", "own output", "random walk", "driven by noise"])
def test_states_that_the_model_does_not_fit_are_told(kind):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(30, 120, 1))
    steady = np.cumsum(np.cumsum(0.1 * noise, axis=1), axis=1)
    noisy = steady + rng.normal(size=noise.shape)
    if kind == "moving average":
        states = ema(noisy, 0.3)
    elif kind == "own output":
        ds = TrajectoryDataset.from_arrays(noisy)
        states = KalmanSmoother().fit(ds).transform(ds).states.reshape(noise.shape)
    elif kind == "random walk":
        states = np.cumsum(noise, axis=1)
    else:  # a stable system of which every state is known exactly
        states = lfilter([1], [1, -0.95], noise, axis=1)
    ds = TrajectoryDataset.from_arrays(states)
    assert "the model of motion does not fit: innovations are correlated in s0" in told(ds)


def test_given_noise_that_is_too_great_is_told(tracks):
    assert "correlated in x (0." in told(tracks[1], measurement_noise=1.0, process_noise=0.01)


@pytest.mark.parametrize("model", ["velocity", "acceleration", "auto"])
@pytest.mark.parametrize("n", [2, 30])
def test_motions_of_the_model_are_not(model, n):
    hidden, times = simulate(n=n, order=2 if model == "acceleration" else 1)
    assert told(measure(hidden, times, [0.05]), model=model) == ""


def test_wrapped_angles_are_told():
    rng = np.random.default_rng(0)
    angle = np.cumsum(0.3 + 0.05 * rng.normal(size=(20, 100, 1)), axis=1)
    noisy = angle + 0.02 * rng.normal(size=angle.shape)
    wrapped = TrajectoryDataset.from_arrays((noisy + np.pi) % (2 * np.pi) - np.pi)
    assert "s0: jumps of about 2 pi" in told(wrapped)
    assert "Unwrap first" in told(wrapped)
    assert "2 pi" not in told(TrajectoryDataset.from_arrays(noisy))
    # others may change by 2 pi, too
    for width in (1.0, 6.0):
        wide = TrajectoryDataset.from_arrays(width * rng.normal(size=(20, 100, 1)))
        assert np.abs(np.diff(wide.states[:, 0])).max() > 5
        assert "2 pi" not in told(wide)


def test_states_that_jump_are_told():
    rng = np.random.default_rng(0)
    level = np.repeat(rng.normal(size=(20, 6)), 25, axis=1)
    ds = TrajectoryDataset.from_arrays(level[..., None] + 0.1 * rng.normal(size=(20, 150, 1)))
    with pytest.warns(SmoothingWarning, match="smoothing moves s0"):
        KalmanSmoother("acceleration", process_noise=1e-6).fit(ds)


def test_flights_through_an_on_board_filter_are_told(data_folder):
    ds = load_crazyflie_gains(data_folder("crazyflie_lee_gains"))[:16].truncate(150)
    messages = told(ds.select_states(["x", "y", "vx", "vy"]), velocities={"x": "vx", "y": "vy"})
    assert "far below the change between samples in x (" in messages
    assert "vy and dy/dt" in messages


def test_constant_states_stay(tracks):
    ds = tracks[1]
    both = TrajectoryDataset.from_arrays(
        [np.column_stack([e.states, np.full(len(e.states), 7.0)]) for e in ds],
        times=[e.times for e in ds],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        smooth = KalmanSmoother(append_velocities=True).fit_transform(both)
    np.testing.assert_allclose(smooth.states[:, 1], 7.0, atol=1e-9)
    np.testing.assert_allclose(smooth.states[:, 3], 0.0, atol=1e-6)


# -- clear errors -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"states": ["xx"]}, "states names 'xx'; the states are .* Did you mean 'x'"),
        ({"states": ["x", "x"]}, "each once"),
        ({"states": []}, "at least one state"),
        ({"velocities": {"x": "dx"}}, "velocities names 'dx'"),
        ({"velocities": {"x": "v", "w": "v"}}, "each once"),
        ({"velocities": {"x": "v"}, "states": ["x"]}, r"velocities names \['v'\], which states="),
        ({"velocities": {"x": "v"}, "append_velocities": ["x"]}, "have none in velocities"),
        ({"append_velocities": ["q"]}, "append_velocities names 'q'"),
        ({"measurement_noise": {"q": 1.0}}, r"measurement_noise names \['q'\]"),
        ({"measurement_noise": {"x": 0.0}}, r"measurement_noise\['x'\] = 0.0 must be positive"),
        ({"process_noise": {"v": 1.0}, "velocities": {"x": "v"}}, "it goes by"),
        ({"measurement_noise": -1.0}, "measurement_noise"),
        ({"model": "jerk"}, "model"),
        ({"training": "both"}, "training"),
        ({"model": "auto", "process_noise": 1.0}, "other units for each model"),
        ({"model": "auto", "process_noise": {"x": 1.0}}, "other units for each model"),
    ],
)
def test_bad_parameters(mixed, parameters, message):
    with pytest.raises(ValueError, match=message):
        KalmanSmoother(**parameters).fit(mixed)


def test_other_states_are_refused(mixed):
    smoother = KalmanSmoother().fit(mixed)
    with pytest.raises(ValueError, match=r"states \['x', 'w'\], the smoother was fitted on"):
        smoother.transform(mixed.select_states(["x", "w"]))


def test_a_name_that_is_taken():
    ds = TrajectoryDataset.from_arrays(
        np.random.default_rng(0).normal(size=(5, 20, 2)), state_names=["x", "d_x"]
    )
    with pytest.raises(ValueError, match=r"states \['d_x'\] already"):
        KalmanSmoother(append_velocities=["x"]).fit_transform(ds)


def test_too_short_episodes():
    ds = TrajectoryDataset.from_arrays(np.random.default_rng(0).normal(size=(5, 2, 1)))
    with pytest.raises(ValueError, match="too short to estimate noise"):
        KalmanSmoother().fit(ds)
    smooth = KalmanSmoother(measurement_noise=1.0, process_noise=1.0).fit_transform(ds)
    assert np.isfinite(smooth.states).all()
