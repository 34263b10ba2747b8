import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from scipy.stats import binomtest
from sklearn.pipeline import make_pipeline

from trajlearn import Forecast, TrajectoryDataset
from trajlearn.evaluation.trust import trust_horizon


def known(errors, lengths=None, *, width=2.0, diverged_at=None, episode=None, dt=0.5):
    """Forecast with errors (n, H) or (n, H, d) of motionless episodes, and the episodes.

    Each state has a training range of `width`; with `episode` (n,) of several starts.
    """
    errors = np.asarray(errors, dtype=float)
    errors = errors.reshape(*errors.shape[:2], -1)
    n, n_steps, d = errors.shape
    lengths = np.broadcast_to(n_steps if lengths is None else lengths, n)
    asked = np.arange(1, n_steps + 1) <= lengths[:, None]
    owner = np.arange(n) if episode is None else np.asarray(episode)
    longest = [lengths[owner == i].max() for i in range(owner.max() + 1)]
    ds = TrajectoryDataset.from_arrays(
        [np.zeros((length + 1, d)) for length in longest],
        dt=dt,
        state_names=["x", "y", "z"][:d],
    )
    forecast = Forecast(
        np.where(asked[..., None], errors, np.nan),
        times=np.where(asked, dt * np.arange(1, n_steps + 1), np.nan),
        horizons=np.arange(1, n_steps + 1),
        lengths=lengths,
        initial_states=np.zeros((n, d)),
        initial_times=np.zeros(n),
        start=np.zeros(n, dtype=np.intp),
        diverged_at=np.zeros(n, dtype=np.intp) if diverged_at is None else np.asarray(diverged_at),
        state_range=np.array([[0.0] * d, [width] * d]),
        state_names=ds.state_names,
        episode=None if episode is None else owner,
    )
    return forecast, ds


def failing(failed_at, n_steps):
    """Errors 0 before and 1 at the step `failed_at` of each episode, and 0 again after it."""
    return (np.arange(1, n_steps + 1) == np.asarray(failed_at)[:, None]).astype(float)


# -- the statement --------------------------------------------------------------------------


def test_the_bound_of_known_failures_is_clopper_and_pearsons():
    # two of 50 fail at step 3, three more at step 5, five more at step 8
    forecast, ds = known(failing([3] * 2 + [5] * 3 + [8] * 5 + [99] * 40, 10))
    trust = trust_horizon(forecast, ds, 0.1, share=0.8)
    assert (trust.horizon, trust.time, trust.limit, trust.n_episodes) == (7, 3.5, "tolerance", 50)
    assert trust.table["n_within"].tolist() == [50, 50, 48, 48, 45, 45, 45, 40, 40, 40]
    assert (trust.table["n_episodes"] == 50).all()
    assert_allclose(trust.table["share_within"], trust.table["n_within"] / 50)
    exact = [
        binomtest(k, 50, alternative="greater").proportion_ci(0.95, method="exact").low
        for k in trust.table["n_within"]
    ]
    assert_allclose(trust.table["lower"], exact)
    assert_allclose(trust.table["time"], 0.5 * np.arange(1, 11))
    assert trust.table.index.name == "horizon"


def test_less_may_be_trusted_of_more_episodes_or_with_more_confidence():
    forecast, ds = known(failing([3] * 2 + [5] * 3 + [8] * 5 + [99] * 40, 10))
    found = [
        trust_horizon(forecast, ds, 0.1, share=share, confidence=confidence).horizon
        for share, confidence in [(0.6, 0.95), (0.7, 0.99), (0.8, 0.95), (0.9, 0.95), (0.9, 0.99)]
    ]
    assert found == [10, 7, 7, 2, 2]
    assert trust_horizon(forecast, ds, 0.1, share=0.9, confidence=0.5).horizon == 4


def test_the_sequence_stops_at_the_first_failure():
    # all that fail do so at step 2; only long episodes, all good, reach steps 4 to 6
    errors = failing([2] * 20 + [99] * 80, 6)
    trust = trust_horizon(*known(errors), 0.1)
    assert (trust.horizon, trust.limit) == (1, "tolerance")


def test_not_even_one_step():
    trust = trust_horizon(*known(np.ones((40, 4))), 0.1)
    assert (trust.horizon, trust.time, trust.limit) == (0, 0.0, "tolerance")
    assert (trust.table["lower"] == 0).all()


@pytest.mark.parametrize("ragged", [False, True], ids=["equal", "ragged"])
def test_the_confidence_holds(ragged):
    """Failures at a constant rate: the true share at horizon h is (1 - rate) ** h.

    At h = 3 it is just below 0.9, and 46 episodes with one failure have a bound just above.
    """
    rng = np.random.default_rng(0)
    rate, n, n_steps, repeats = 0.0346, 46, 8, 300
    wrong, found = 0, []
    for _ in range(repeats):
        failed_at = rng.geometric(rate, size=n)
        # an episode that fails ends soon after it, so that lengths and failures are related
        lengths = np.minimum(n_steps, failed_at + rng.integers(0, 4, n)) if ragged else n_steps
        forecast, ds = known(failing(failed_at, n_steps), lengths)
        trust = trust_horizon(forecast, ds, 0.1)
        wrong += (1 - rate) ** trust.horizon < 0.9
        found.append(trust.horizon)
    assert wrong <= 0.05 * repeats + 2 * np.sqrt(repeats * 0.05 * 0.95)
    assert wrong > 0.01 * repeats  # not idle
    assert np.mean(found) > 0.5


# -- what counts ----------------------------------------------------------------------------


def test_a_number_limits_the_root_mean_square_over_states_in_training_ranges():
    # off by 3 and 4 of ranges of 10: sqrt((0.09 + 0.16) / 2)
    errors = np.broadcast_to([3.0, 4.0], (30, 2, 2))
    forecast, ds = known(errors, width=10.0)
    limit = np.sqrt(0.125)
    assert trust_horizon(forecast, ds, limit * 1.001).horizon == 2
    assert trust_horizon(forecast, ds, limit * 0.999).horizon == 0


def test_a_mapping_limits_named_states_in_their_units():
    errors = np.zeros((30, 3, 3))
    errors[..., 0] = [0.1, -0.2, 0.3]
    errors[..., 1] = [-5.0, -5.0, -7.0]
    errors[..., 2] = 1e6
    forecast, ds = known(errors, width=10.0)
    assert trust_horizon(forecast, ds, {"x": 0.25}).horizon == 2
    assert trust_horizon(forecast, ds, {"y": 6.0}).horizon == 2
    assert trust_horizon(forecast, ds, {"y": 8.0, "x": 0.15}).horizon == 1
    assert trust_horizon(forecast, ds, {"y": 8.0, "x": 0.35}).horizon == 3
    trust = trust_horizon(forecast, ds, {"x": 0.25})
    assert trust.tolerance == {"x": 0.25}


def test_a_constant_state_has_its_own_unit():
    forecast, ds = known(np.full((30, 2), 0.3), width=0.0)
    assert trust_horizon(forecast, ds, {"x": 0.31}).horizon == 2
    assert trust_horizon(forecast, ds, {"x": 0.29}).horizon == 0


def test_a_diverged_forecast_has_left_any_tolerance():
    diverged_at = np.array([2] * 10 + [0] * 30)
    errors = np.zeros((40, 4))
    for tolerance in (1e9, {"x": 1e9}):
        trust = trust_horizon(*known(errors, diverged_at=diverged_at), tolerance)
        assert trust.table["n_within"].tolist() == [40, 30, 30, 30]
        assert trust.horizon == 1


def test_short_episodes_count_as_long_as_they_last_and_failures_for_ever():
    # one ends after a step and 10 after 2 within the tolerance, 5 after 2 outside, 45 last 4
    failed_at = [99] * 11 + [2] * 5 + [99] * 45
    lengths = [1] + [2] * 15 + [4] * 45
    trust = trust_horizon(*known(failing(failed_at, 4), lengths), 0.1, share=0.5)
    assert trust.table["n_episodes"].tolist() == [61, 60, 50, 50]
    assert trust.table["n_within"].tolist() == [61, 55, 45, 45]


def test_it_ends_where_too_few_episodes_last_and_says_so():
    lengths = [2] * 20 + [4] * 28
    trust = trust_horizon(*known(np.zeros((48, 4)), lengths), 0.1)
    assert (trust.horizon, trust.limit) == (2, "episodes")
    trust = trust_horizon(*known(np.zeros((49, 4)), [*lengths, 4]), 0.1)
    assert (trust.horizon, trust.limit) == (4, "forecast")


def test_all_starts_of_an_episode_have_to_stay_within():
    # episode i has forecasts of 4 and of 2 steps; the short one of every tenth fails at step 2
    episode = np.repeat(np.arange(40), 2)
    failed_at = np.full(80, 99)
    failed_at[1::20] = 2
    forecast, ds = known(failing(failed_at, 4), np.tile([4, 2], 40), episode=episode)
    trust = trust_horizon(forecast, ds, 0.1, share=0.7)
    assert trust.n_episodes == 40
    assert trust.table["n_episodes"].tolist() == [40] * 4
    assert trust.table["n_within"].tolist() == [40, 36, 36, 36]


def test_the_order_of_the_episodes_does_not_matter():
    rng = np.random.default_rng(0)
    errors, lengths = rng.exponential(size=(60, 8)).cumsum(axis=1), rng.integers(3, 9, size=60)
    order = rng.permutation(60)
    one = trust_horizon(*known(errors, lengths), 1.8, share=0.5)
    other = trust_horizon(*known(errors[order], lengths[order]), 1.8, share=0.5)
    assert 0 < one.horizon == other.horizon
    pd.testing.assert_frame_equal(one.table, other.table)


def test_the_result_is_short_to_print():
    trust = trust_horizon(*known(np.zeros((30, 4))), 0.1)
    assert repr(trust) == (
        "TrustHorizon(horizon=4, time=2, limit='forecast', share=0.9, confidence=0.95, "
        "tolerance=0.1, n_episodes=30)"
    )


# -- forecasters ----------------------------------------------------------------------------


def test_an_estimator_a_pipeline_and_a_forecast_agree(persistence, state_selector, make_ramps):
    # training range of x: 0..8; the motion of test episodes is 1 or 2 a step
    train = make_ramps([2.0], [4])
    ds = make_ramps([1.0] * 59 + [2.0], [6] * 60)
    model = persistence().fit(train)
    expected = trust_horizon(model.predict(ds), ds, {"x": 3.5})
    assert expected.horizon == 3
    pipeline = make_pipeline(state_selector(["x"]), persistence()).fit(train)
    for forecaster in (model, pipeline):
        trust = trust_horizon(forecaster, ds, {"x": 3.5})
        pd.testing.assert_frame_equal(trust.table, expected.table)


def test_a_horizon_cuts_the_table(persistence, make_ramps):
    ds = make_ramps([1.0] * 40, [6] * 40)
    model = persistence().fit(make_ramps([2.0], [4]))
    for forecaster in (model, model.predict(ds)):
        trust = trust_horizon(forecaster, ds, 100.0, horizon=2)
        assert (trust.horizon, trust.limit, len(trust.table)) == (2, "forecast", 2)


def test_forecasts_begin_where_told(persistence, make_ramps):
    ds = make_ramps([1.0] * 40, [6] * 40)
    model = persistence().fit(make_ramps([2.0], [4]))
    trust = trust_horizon(model, ds, {"x": 2.5}, start=3, horizon=5)
    assert (trust.horizon, trust.time, len(trust.table)) == (2, 2.0, 3)


# -- errors ---------------------------------------------------------------------------------


def test_too_few_episodes_are_refused_with_the_number_needed():
    message = r"20 episodes can show at most a share of 0\.861 .* give at least 29"
    with pytest.raises(ValueError, match=message):
        trust_horizon(*known(np.zeros((20, 3))), 0.1)
    with pytest.raises(ValueError, match="28 episodes"):
        trust_horizon(*known(np.zeros((28, 3))), 0.1)
    assert trust_horizon(*known(np.zeros((29, 3))), 0.1).horizon == 3
    assert trust_horizon(*known(np.zeros((1, 3))), 0.1, share=0.5, confidence=0.5).horizon == 3


@pytest.mark.parametrize(
    ("tolerance", "settings", "message"),
    [
        (0.0, {}, "tolerance = 0.0 must be a positive"),
        (np.nan, {}, "tolerance = nan must be a positive"),
        ({"x": -1.0}, {}, "tolerance of state 'x' = -1.0"),
        ({}, {}, "tolerance names no state"),
        ({"v": 1.0}, {}, "no state v was both forecast and logged; there are x"),
        (0.1, {"share": 1.0}, "share = 1.0 must lie between 0 and 1"),
        (0.1, {"confidence": 0}, "confidence = 0 must lie between 0 and 1"),
        (0.1, {"horizon": 0}, "horizon is at least 1 step"),
        (0.1, {"start": 1}, "start: a ready forecast has its own"),
    ],
    ids=["zero", "nan", "negative", "empty", "unknown", "share", "confidence", "horizon", "start"],
)
def test_bad_settings_are_refused(tolerance, settings, message):
    forecast, ds = known(np.zeros((30, 3)))
    with pytest.raises(ValueError, match=message):
        trust_horizon(forecast, ds, tolerance, **settings)


def test_a_forecast_that_leaves_out_steps_is_refused():
    forecast, ds = known(np.zeros((30, 3)))
    with pytest.raises(ValueError, match="leaves out steps"):
        trust_horizon(forecast.at([1, 3]), ds, 0.1)


def test_other_episodes_are_refused():
    forecast, ds = known(np.zeros((30, 3)))
    with pytest.raises(ValueError, match="29 episodes"):
        trust_horizon(forecast, ds[:29], 0.1)
    with pytest.raises(ValueError, match="sampling"):
        trust_horizon(forecast, known(np.zeros((30, 3)), dt=0.1)[1], 0.1)


def test_what_predicts_no_states_is_refused():
    class Rewards:
        def predict(self, ds):
            return np.zeros(len(ds))

    with pytest.raises(TypeError, match=r"Rewards.* returned ndarray"):
        trust_horizon(Rewards(), known(np.zeros((30, 3)))[1], 0.1)
