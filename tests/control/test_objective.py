"""Predicted returns against closed forms, simulators and loops written out."""

import warnings
from statistics import NormalDist

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from tests.dynamics.systems import SMALL, A, Affine, B, gain_policy, linear, quadratic
from trajlearn import (
    BlockScaler,
    CalibratedForecaster,
    Cartpole,
    DirectRewardGP,
    DirectRewardNN,
    KalmanSmoother,
    LSTMRegressor,
    MLPEnsembleRegressor,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.control import objective as module
from trajlearn.control.objective import PredictedReturn
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import HorizonWarning, MissingFieldError, NoUncertaintyError
from trajlearn.trajectories.rewards import episode_rewards

DT, HORIZON = 0.1, 12
THETA = np.array([[0.3], [-0.4], [0.9]])
STARTS = np.array([[0.5], [-1.0]])


def first(states):
    return states[..., 0]


def affine(states):
    return 1.0 - 2.0 * states[..., 0]


def square(states):
    return -(states**2).sum(axis=-1)


def drifting(n=12, *, steps=15, d_s=1):
    """s_t = s_0 + theta t, and further states that are multiples of the first."""
    rng = np.random.default_rng(0)
    theta, start = rng.uniform(-1, 1, (n, 1)), rng.normal(size=(n, 1))
    position = start + theta * DT * np.arange(steps + 1)
    states = position[..., None] * np.arange(1, d_s + 1)
    return TrajectoryDataset.from_arrays(states, params=theta, dt=DT)


@pytest.fixture(scope="module")
def drift():
    """A trajectory model that is exact: h theta is of second degree."""
    return TrajectoryRegressor(quadratic(), scaler=BlockScaler(), gate=None).fit(drifting())


@pytest.fixture(scope="module")
def plant():
    """A one-step model that is exact."""
    return OneStepRegressor(LinearRegression()).fit(linear())


@pytest.fixture(scope="module")
def ensemble():
    return TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(drifting())


def objective(model, **settings):
    given = {"reward": affine, "horizon": HORIZON, "dt": DT, "initial_states": STARTS}
    return PredictedReturn(model, **(given | settings))


def drift_return(theta=THETA, starts=STARTS, horizon=HORIZON):
    """Closed form of the mean return of the affine reward."""
    elapsed = DT * horizon * (horizon + 1) / 2
    return horizon * (1 - 2 * starts.mean()) - 2 * elapsed * theta[:, 0]


class Simulator:
    """A model whose forecasts are given by a function of (states, params, horizons)."""

    def __init__(self, function):
        self.function = function
        self.asked = []

    def predict_trajectory(self, initial_states, *, horizons, params=None, **settings):
        self.asked.append(settings)
        mean = self.function(initial_states, params, horizons)
        n, n_steps, d_s = mean.shape
        gone = ~np.isfinite(mean).all(axis=2)
        return Forecast(
            mean,
            times=np.tile(horizons, (n, 1)),
            horizons=horizons,
            lengths=np.full(n, n_steps),
            initial_states=initial_states,
            initial_times=np.zeros(n),
            start=np.zeros(n, dtype=int),
            diverged_at=np.where(gone.any(axis=1), gone.argmax(axis=1) + 1, 0),
            state_range=np.array([[-1.0] * d_s, [1.0] * d_s]),
            state_names=tuple("abcdefgh"[:d_s]),
        )


# -- returns of mean trajectories ----------------------------------------------------------


def test_the_return_is_the_sum_of_step_rewards_averaged_over_initial_states(drift):
    found = objective(drift)(THETA)
    np.testing.assert_allclose(found.value, drift_return(), atol=1e-8)
    np.testing.assert_array_equal(found.value, found.reward)
    assert found.std is None
    assert found.violation is None


@pytest.mark.parametrize("every", [2, 3, 5, 11, 12, 40])
def test_a_reward_linear_in_time_needs_few_horizons(drift, every):
    few = objective(drift, every=every)
    np.testing.assert_allclose(few(THETA).value, drift_return(), atol=1e-8)
    assert len(few.horizons) == -(-HORIZON // every)
    assert few.horizons[-1] == pytest.approx(DT * HORIZON)


def test_a_return_is_what_the_attributes_say(drift):
    for every in (1, 4):
        few = objective(drift, every=every)
        mean = drift.predict_trajectory(
            np.tile(STARTS, (3, 1)), params=np.repeat(THETA, 2, axis=0), horizons=few.horizons
        ).mean
        returns = np.tile(few.start_part, 3) + affine(mean) @ few.weights
        np.testing.assert_allclose(few(THETA).value, returns.reshape(3, 2).mean(axis=1))


def test_a_curved_reward_is_approached_by_more_horizons(drift):
    exact = objective(drift, reward=square)(THETA).value
    errors = [
        np.abs(objective(drift, reward=square, every=every)(THETA).value - exact).max()
        for every in (6, 3, 2)
    ]
    assert 0 < errors[2] < errors[1] < errors[0] < 0.3 * np.abs(exact).max()


def test_without_a_reward_of_the_start_the_first_horizon_stands_for_what_is_before(drift):
    found = objective(drift, reward=lambda states, times: times, every=4)
    # knots at 0.4, 0.8 and 1.2; the first also at 0
    steps = np.interp(np.arange(1, HORIZON + 1), [4, 8, 12], [0.4, 0.8, 1.2])
    np.testing.assert_allclose(found(THETA).value, steps.sum())


def test_the_step_of_the_model_is_known_to_it(plant):
    default = PredictedReturn(plant, reward=first, horizon=3, initial_states=[0.0, 1.0])
    assert default.dt == plant.dt_
    with pytest.raises(ValueError, match="give dt="):
        PredictedReturn(object(), reward=first, horizon=3, initial_states=[0.0])


def test_no_std_is_asked_for_where_only_the_mean_counts():
    simulator = Simulator(lambda s, theta, h: s[:, None] + theta[:, None] * h[:, None])
    np.testing.assert_allclose(objective(simulator)(THETA).value, drift_return())
    assert simulator.asked == [{}]


# -- one-step models -----------------------------------------------------------------------


def rolled(start, steps, act):
    """States and actions of the plant, step after step."""
    states, actions = [np.asarray(start, dtype=float)], []
    for t in range(steps):
        actions.append(act(states[-1], t))
        states.append(A @ states[-1] + B @ actions[-1])
    return np.array(states[1:]), np.array(actions)


PAIRS = np.array([[0.3, 0.1], [0.0, 0.4]])
TWO = np.array([[1.0, 0.0], [0.2, -0.5]])


def cost(states, actions, times):
    return -(states**2).sum(axis=-1) - 0.1 * actions[..., 0] ** 2 + times


def test_a_one_step_model_with_a_policy(plant):
    expected = []
    for theta in PAIRS:
        paths = [rolled(s, 6, lambda s, t, theta=theta: np.array([-theta @ s])) for s in TWO]
        expected.append(np.mean([cost(*path, np.arange(1, 7)).sum() for path in paths]))
    settings = {"reward": cost, "horizon": 6, "dt": 1.0, "initial_states": TWO}
    given = PredictedReturn(plant, policy=gain_policy, **settings)
    np.testing.assert_allclose(given(PAIRS).value, expected)
    own = OneStepRegressor(LinearRegression(), policy=gain_policy).fit(linear())
    np.testing.assert_allclose(PredictedReturn(own, **settings)(PAIRS).value, expected)
    with pytest.raises(MissingFieldError, match="actions"):
        PredictedReturn(plant, **settings)(PAIRS)
    with pytest.raises(ValueError, match="every=1"):
        PredictedReturn(plant, policy=gain_policy, every=2, **settings)


@pytest.mark.parametrize("every", [1, 3])
def test_a_one_step_model_of_planned_actions(plant, every):
    actions = np.random.default_rng(0).normal(size=(3, 6, 1))
    model = make_pipeline(FunctionTransformer(), plant)
    expected = []
    for plan in actions:
        paths = [rolled(s, 6, lambda s, t, plan=plan: plan[t]) for s in TWO]
        rewards = np.array([cost(*path, np.arange(1, 7)) for path in paths]).mean(axis=0)
        steps = np.arange(1, 7)
        known = steps[every - 1 :: every]
        expected.append(np.interp(steps, known, rewards[known - 1]).sum())
    settings = {"reward": cost, "horizon": 6, "dt": 1.0, "initial_states": TWO, "every": every}
    for asked in (plant, model):
        planned = PredictedReturn(asked, decision="actions", **settings)
        np.testing.assert_allclose(planned(actions).value, expected)
    for wrong in (actions[:, :5], actions[0], actions[..., :0]):
        with pytest.raises(ValueError, match=r"actions|shape"):
            planned(wrong)


# -- trajectories that end -----------------------------------------------------------------


@pytest.fixture(scope="module")
def cartpole():
    """Falling and standing poles, and a model that is the plant without its limits."""
    env, endless = Cartpole("unstable"), Cartpole("unstable", limit_scale=np.inf)
    starts = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 4))
    params = np.concatenate(
        [np.random.default_rng(2).uniform(*env.param_bounds.T, (6, 4)), env.lqr_gain[None]]
    )

    def simulate(states, params, horizons):
        paths = [endless.rollout(s[None], p, 60)[0].states for s, p in zip(states, params)]
        steps = np.round(horizons / env.dt).astype(int)
        return np.array(paths)[:, steps]

    return env, starts, params, Simulator(simulate)


def test_an_early_end_costs_what_it_costs_in_a_real_trial(cartpole):
    env, starts, params, model = cartpole
    asked = {"reward": env.reward, "horizon": 60, "dt": env.dt, "initial_states": starts}
    found = PredictedReturn(model, is_terminal=env.is_terminal, terminal_reward=-3.0, **asked)
    expected, lengths = [], []
    for theta in params:
        trials = env.rollout(starts, np.tile(theta, (2, 1)), 60)
        lengths += trials.lengths.tolist()
        means = episode_rewards(trials, env.reward, horizon=60, terminal_reward=-3.0)
        expected.append(60 * means.mean())
    # some fell, some stand
    assert min(lengths) < 60 == max(lengths)
    np.testing.assert_allclose(found(params).value, expected)
    ignored = PredictedReturn(model, **asked)(params).value
    assert (np.abs(ignored - expected) > 1).any()


def line(states, params, horizons):
    return states[:, None] + params[:, None] * horizons[:, None]


@pytest.mark.parametrize(
    ("every", "expected"),
    # s = 1, 2, ..., 6 ends at 3 (with the reward of that step), or at the next knot, 4
    [(1, 1 + 2 + 3 - 3 * 7), (2, 1 + 2 + 3 + 4 - 2 * 7), (5, 15 - 7), (6, 21.0)],
)
def test_an_end_between_two_horizons_is_one_at_the_next(every, expected):
    found = PredictedReturn(
        Simulator(line),
        reward=first,
        horizon=6,
        dt=1.0,
        initial_states=[0.0],
        is_terminal=lambda s: s[..., 0] >= 3,
        terminal_reward=-7.0,
        every=every,
    )
    assert found([[1.0]]).value[0] == pytest.approx(expected)
    # what comes after the end does not count, were it NaN
    strange = PredictedReturn(
        Simulator(line),
        reward=lambda s: np.where(s[..., 0] > 4, np.nan, s[..., 0]),
        horizon=6,
        dt=1.0,
        initial_states=[0.0],
        is_terminal=lambda s: s[..., 0] >= 3,
        terminal_reward=-7.0,
    )
    assert strange([[1.0]]).value[0] == 1 + 2 + 3 - 3 * 7


def exploding(states, params, horizons):
    """The line, gone from s = 3 on where theta is positive."""
    path = line(states, params, horizons)
    return np.where(path >= 3, np.inf, path)


def test_a_forecast_that_diverges_earns_nothing_from_there_on():
    settings = {"reward": first, "horizon": 6, "dt": 1.0, "initial_states": [0.0]}
    model = Simulator(exploding)
    found = PredictedReturn(model, terminal_reward=-7.0, **settings)([[1.0], [0.1]])
    np.testing.assert_allclose(found.value, [1 + 2 - 4 * 7, 2.1])
    late = settings | {"initial_states": [0.5]}
    few = PredictedReturn(model, terminal_reward=-7.0, every=2, **late)([[1.0], [5.0]])
    # known at 2; gone before anything is known
    np.testing.assert_allclose(few.value, [1.5 + 2.5 - 4 * 7, -6 * 7])
    found = PredictedReturn(model, **settings)([[1.0], [0.1]])
    np.testing.assert_allclose(found.value, [-np.inf, 2.1])
    ends = PredictedReturn(
        model, is_terminal=lambda s: s[..., 0] >= 2, terminal_reward=-7.0, **settings
    )
    # it had ended before it diverged
    assert ends([[1.0]]).value[0] == 1 + 2 - 4 * 7
    # and no end is made of what stands for states that are unknown
    never = PredictedReturn(
        model, is_terminal=lambda s: s[..., 0] <= 0, terminal_reward=-7.0, **settings
    )
    assert never([[1.0]]).value[0] == 1 + 2 - 4 * 7


# -- other kinds of models -----------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.SmoothingWarning")
@pytest.mark.parametrize("every", [1, 5])
def test_a_pipeline_is_asked_through_predict(drift, every):
    expected = objective(drift, every=every)(THETA).value
    for model in (
        make_pipeline(FunctionTransformer(), drift),
        make_pipeline(KalmanSmoother().fit(drifting()), drift),
        FrozenEstimator(drift),
    ):
        found = objective(model, every=every)(THETA).value
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_one_step_baseline_in_a_pipeline_is_rolled_out_step_by_step():
    model = TrajectoryRegressor(
        LinearRegression(),
        baseline=OneStepRegressor(LinearRegression(), inputs="params"),
        random_state=0,
    ).fit(drifting())
    pipeline = make_pipeline(FunctionTransformer(), model)
    for every in (1, 5):
        expected = objective(model, every=every)(THETA).value
        np.testing.assert_allclose(objective(pipeline, every=every)(THETA).value, expected)


def test_std_is_about_the_mean_return_also_where_the_mean_trajectory_is_judged(ensemble):
    asked = {"reward": square, "constraint": lambda states: states[..., 0] < 9, "n_samples": 5}
    mean, expected = (
        objective(ensemble, risk=risk, random_state=0, **asked)(THETA)
        for risk in ("mean", "expected")
    )
    np.testing.assert_array_equal(mean.expected, expected.reward)
    np.testing.assert_array_equal(mean.std, expected.std)
    np.testing.assert_array_equal(expected.expected, expected.value)
    assert (mean.reward != mean.expected).all()
    assert objective(ensemble, reward=square)(THETA).expected is None


def test_a_pipeline_that_selects_states_is_given_all_of_them():
    ds = drifting(d_s=2)
    select = FunctionTransformer(lambda ds: ds.select_states(["s1"]))
    model = make_pipeline(
        select, TrajectoryRegressor(quadratic(), scaler=BlockScaler(), gate=None)
    ).fit(ds)
    found = objective(model, initial_states=STARTS * [1, 2])(THETA).value
    np.testing.assert_allclose(found, drift_return(starts=2 * STARTS, theta=2 * THETA), atol=1e-8)
    with pytest.raises(ValueError, match="s1"):
        objective(model, initial_states=STARTS * [1, 2], state_names=["x", "y"])(THETA)


@pytest.mark.parametrize("kind", [DirectRewardGP, DirectRewardNN])
def test_a_direct_reward_model_predicts_rows(kind):
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (60, 2))
    y = 1 - 2 * rows[:, 0] - 1.3 * rows[:, 1]
    model = kind(random_state=0).fit(rows, y)
    found = objective(model, dt=None)(THETA)
    # a network of few rows is some 0.15 a step off
    np.testing.assert_allclose(found.value, drift_return(), atol=3.0)
    asked = np.column_stack([np.tile(STARTS, (3, 1)), np.repeat(THETA, 2)])
    mean, std = model.predict(asked, return_std=True)
    np.testing.assert_allclose(found.value, 12 * mean.reshape(3, 2).mean(axis=1))
    low = objective(model, risk="lcb", kappa=2.0)(THETA)
    np.testing.assert_allclose(low.std, 12 * std.reshape(3, 2).mean(axis=1))
    np.testing.assert_allclose(low.value, low.reward - 2 * low.std)
    with pytest.raises(ValueError, match="features"):
        objective(model)(np.ones((3, 2)))
    for wrong in ({"constraint": affine}, {"decision": "actions"}):
        with pytest.raises(ValueError, match="predicts rewards, not states"):
            objective(model, **wrong)


def test_a_direct_reward_model_of_episodes_behind_a_transformer():
    ds = drifting(60)
    model = DirectRewardGP(reward=affine, horizon=HORIZON, random_state=0)
    direct = objective(model.fit(ds))(THETA).value
    np.testing.assert_allclose(direct, drift_return(), atol=0.2)
    behind = objective(make_pipeline(FunctionTransformer(), model))(THETA).value
    np.testing.assert_allclose(behind, direct)


def test_references_phase_and_context_reach_the_model():
    rng = np.random.default_rng(0)
    ds = TrajectoryDataset.from_arrays(
        rng.normal(size=(8, 11, 1)),
        params=rng.normal(size=(8, 1)),
        references=rng.normal(size=(8, 11, 1)),
        context={"load": np.array(["a", "b"] * 4)},
        time_origin=rng.uniform(-1, 0, 8),
        dt=DT,
    )
    model = TrajectoryRegressor(random_state=0).set_params(**SMALL).fit(ds)
    signal = np.cos(np.arange(HORIZON - 1))[:, None]

    def reward(states, references, times):
        return states[..., 0] * references[..., 0] + times

    asked = {
        "reward": reward,
        "horizon": 10,
        "references": signal,
        "context": {"load": "b"},
        "phase": 0.7,
    }
    horizons = DT * np.arange(1, 11)
    mean = model.predict_trajectory(
        np.tile(STARTS, (3, 1)),
        params=np.repeat(THETA, 2, axis=0),
        horizons=horizons,
        references=lambda t: np.interp(t, DT * np.arange(11), signal[:, 0])[:, None],
        context={"load": "b"},
        phase=0.7,
    ).mean[..., 0]
    expected = (mean * signal[1:, 0] + horizons).sum(axis=1).reshape(3, 2).mean(axis=1)
    np.testing.assert_allclose(objective(model, **asked)(THETA).value, expected)
    pipeline = make_pipeline(FunctionTransformer(), model)
    np.testing.assert_allclose(objective(pipeline, **asked)(THETA).value, expected)
    for other in ({"phase": 0.1}, {"context": {"load": "a"}}, {"references": 2 * signal}):
        assert (objective(model, **(asked | other))(THETA).value != expected).all()
    with pytest.raises(ValueError, match=r"references has shape \(4, 1\)"):
        objective(model, **(asked | {"references": signal[:4]}))


# -- uncertainty ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gaussian():
    """Every trajectory is an offset of its own, N(0, 0.5^2), that never changes."""
    model = TrajectoryRegressor(
        Affine(0.0, std=0.5), scaler=FunctionTransformer(), baseline=None
    ).fit(drifting())
    model.target_scale_, model.noise_time_ = np.ones(1), np.array([np.inf])
    return model


def test_the_lower_bound_of_a_gaussian_return(gaussian):
    settings = {"reward": lambda s: s[..., 0] + 1, "n_samples": 4000, "random_state": 0}
    one = objective(gaussian, risk="lcb", kappa=1.5, initial_states=[0.0], **settings)(THETA)
    np.testing.assert_allclose(one.std, 0.5 * HORIZON, rtol=0.05)
    np.testing.assert_allclose(one.reward, HORIZON, rtol=0.05)
    np.testing.assert_allclose(one.value, one.reward - 1.5 * one.std)
    assert one.violation is None
    # the mean over two initial states, whose noise is independent
    two = objective(gaussian, risk="lcb", **settings)(THETA)
    np.testing.assert_allclose(two.std, 0.5 * HORIZON / np.sqrt(2), rtol=0.05)


def test_the_mean_return_is_not_the_return_of_the_mean_trajectory(gaussian):
    settings = {"reward": lambda s: -(s[..., 0] ** 2), "random_state": 0, "initial_states": [0.0]}
    mean = objective(gaussian, **settings)(THETA)
    np.testing.assert_allclose(mean.value, 0.0, atol=1e-12)
    expected = objective(gaussian, risk="expected", n_samples=4000, **settings)(THETA)
    np.testing.assert_allclose(expected.value, -(0.5**2) * HORIZON, rtol=0.05)
    # to the bit what a lower bound without a width is
    bound = objective(gaussian, risk="lcb", kappa=0.0, n_samples=4000, **settings)(THETA)
    for name in ("value", "reward", "std"):
        np.testing.assert_array_equal(getattr(expected, name), getattr(bound, name))


@pytest.mark.parametrize("risk", ["mean", "expected"])
def test_a_direct_reward_model_predicts_an_expected_return_already(risk):
    rows = np.random.default_rng(0).uniform(size=(12, 2))
    model = DirectRewardNN(random_state=0).set_params(estimator__max_steps=5)
    model.fit(rows, rows.sum(axis=1))
    found = objective(model, risk=risk, initial_states=[0.2])([[0.5]])
    np.testing.assert_allclose(found.value, HORIZON * model.predict([[0.2, 0.5]]))
    assert found.std is None


def test_the_share_that_breaks_a_constraint(gaussian):
    found = objective(
        gaussian,
        constraint=lambda s: s[..., 0] < 0.6,
        n_samples=4000,
        random_state=0,
        reward=first,
    )(THETA)
    np.testing.assert_allclose(found.violation, 1 - NormalDist().cdf(1.2), atol=0.02)
    # the value is that of the mean trajectory still
    np.testing.assert_allclose(found.value, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.std, 0.5 * HORIZON / np.sqrt(2), rtol=0.05)


def test_what_comes_after_an_end_breaks_nothing(gaussian):
    # all end at once, those above 0.6 in a state that is forbidden
    end = {"is_terminal": lambda s: np.abs(s[..., 0]) > 0.6, "terminal_reward": -1.0}
    settings = {"n_samples": 500, "random_state": 0, "risk": "lcb", "reward": first}
    # where a trial begins is no matter
    settings["initial_states"] = [5.0]
    found = objective(gaussian, constraint=lambda s: s[..., 0] < 0.6, **end, **settings)(THETA)
    np.testing.assert_allclose(found.violation, 1 - NormalDist().cdf(1.2), atol=0.05)
    alone = objective(gaussian, **settings)(THETA)
    assert (found.reward < alone.reward).all()


def test_a_sample_that_diverges_breaks_a_constraint_unless_it_had_ended():
    class Sampler(Simulator):
        def predict_trajectory(self, initial_states, *, n_samples, random_state, **settings):
            forecast = super().predict_trajectory(initial_states, **settings)
            # s = 1, 2, ... in one sample; gone from 3 on; gone from 2 on
            forecast.samples = np.stack([forecast.mean] * 3)
            forecast.samples[1, :, 2:] = np.inf
            forecast.samples[2, :, 1:] = np.inf
            return forecast

    settings = {"reward": first, "horizon": 4, "dt": 1.0, "initial_states": [0.0]}
    settings |= {"constraint": lambda s: s[..., 0] < 99, "n_samples": 3, "risk": "lcb"}
    found = PredictedReturn(Sampler(line), terminal_reward=-1.0, **settings)([[1.0]])
    assert found.violation[0] == pytest.approx(2 / 3)
    returns = [1 + 2 + 3 + 4, 1 + 2 - 2, 1 - 3]
    np.testing.assert_allclose([found.reward[0], found.std[0]], [np.mean(returns), np.std(returns)])
    end = {"is_terminal": lambda s: s[..., 0] >= 2, "terminal_reward": -1.0}
    found = PredictedReturn(Sampler(line), **end, **settings)([[1.0]])
    assert found.violation[0] == pytest.approx(1 / 3)
    worst = PredictedReturn(Sampler(line), **settings)([[1.0]])
    assert (worst.value[0], worst.std[0]) == (-np.inf, np.inf)


def test_without_a_variance_there_is_no_bound(drift):
    with pytest.raises(NoUncertaintyError):
        objective(drift, risk="lcb")(THETA)


MODELS = {
    "T": lambda: TrajectoryRegressor(random_state=0).set_params(**SMALL, estimator__n_members=3),
    "one-step": lambda: OneStepRegressor(
        MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=20, n_members=3),
        inputs="params",
        random_state=0,
    ),
    "one-step, drawn": lambda: MODELS["one-step"]().set_params(propagation="ts1"),
    "one-step, Gaussians": lambda: MODELS["one-step"]().set_params(propagation="unscented"),
    "recurrent": lambda: LSTMRegressor(hidden_size=4, max_steps=5, inputs="params", random_state=0),
    "calibrated": lambda: CalibratedForecaster(MODELS["T"](), cv=0.5, random_state=0),
    "pipeline": lambda: make_pipeline(FunctionTransformer(), MODELS["T"]()),
}


@pytest.mark.parametrize("name", list(MODELS))
def test_all_candidates_get_the_same_numbers(name, monkeypatch):
    model = MODELS[name]().fit(drifting(6))
    asked = objective(
        model,
        risk="lcb",
        n_samples=6,
        constraint=lambda s: s[..., 0] < 0.6,
        random_state=3,
        horizon=6,
    )
    theta = np.concatenate([THETA, THETA])
    found = asked(theta)
    assert (found.std > 0).all()
    assert len(np.unique(found.value)) == 3
    np.testing.assert_array_equal(found.value[:3], found.value[3:])
    np.testing.assert_array_equal(found.violation[:3], found.violation[3:])
    for again in (asked(theta[1:4]), asked(theta[[1]])):
        np.testing.assert_array_equal(again.value, found.value[1 : len(again.value) + 1])
    # in chunks of one candidate
    monkeypatch.setattr(module, "_CHUNK_STATES", 1)
    chunked = asked(theta)
    np.testing.assert_array_equal(chunked.value, found.value)
    np.testing.assert_array_equal(chunked.violation, found.violation)
    other = objective(model, risk="lcb", n_samples=6, random_state=4, horizon=6)
    assert (other(THETA).value != found.value[:3]).all()


def test_the_doubt_about_the_plant_does_not_average_out_over_starts():
    model = MODELS["one-step"]().fit(drifting(6))
    # members that differ, without noise of their own
    model.estimator_.residual_std_[:] = 0.0
    few, many = (
        objective(model, risk="expected", n_samples=40, initial_states=starts, random_state=0)
        for starts in (STARTS[:1], np.repeat(STARTS[:1], 16, axis=0))
    )
    assert (few(THETA).std > 0).all()
    np.testing.assert_allclose(many(THETA).std, few(THETA).std, rtol=1e-6)


def test_chunks_change_nothing(ensemble, monkeypatch):
    theta = np.random.default_rng(0).uniform(-1, 1, (50, 1))
    whole = objective(ensemble)(theta).value
    monkeypatch.setattr(module, "_CHUNK_STATES", 7 * HORIZON * 2)
    np.testing.assert_array_equal(objective(ensemble)(theta).value, whole)
    before = theta.copy()
    objective(ensemble)(theta)
    np.testing.assert_array_equal(theta, before)


# -- planning step after step --------------------------------------------------------------


def test_the_same_objective_from_elsewhere(drift):
    base = objective(drift, every=4)
    moved = base.starting_at([[2.0]])
    new = objective(drift, every=4, initial_states=[2.0])
    np.testing.assert_array_equal(moved(THETA).value, new(THETA).value)
    np.testing.assert_allclose(base(THETA).value, drift_return(), atol=1e-8)


def test_policies_references_and_rewards_know_the_time(plant):
    def swinging(states, params, times):
        return params[:, :1] * np.cos(times)[:, None]

    expected = []
    for theta in PAIRS:
        path, _ = rolled(TWO[0], 5, lambda s, t, theta=theta: theta[:1] * np.cos(t + 3.0))
        times = np.arange(4.0, 9.0)
        expected.append((path[:, 0] * np.sin(times) * times).sum())
    moved = PredictedReturn(
        plant,
        reward=lambda states, times, references: states[..., 0] * references[..., 0] * times,
        horizon=5,
        dt=1.0,
        initial_states=TWO,
        policy=swinging,
        references=lambda t: np.sin(t)[:, None],
    ).starting_at(TWO[0], time=3.0)
    np.testing.assert_allclose(moved(PAIRS).value, expected)


def test_rows_of_references_count_from_the_start_time(plant):
    def tracking(references, **settings):
        return PredictedReturn(
            plant,
            reward=lambda states, references: references[..., 0],
            horizon=3,
            dt=1.0,
            initial_states=TWO,
            policy=lambda states, params, times: params[:, :1],
            references=references,
            **settings,
        )

    rows = np.array([[1.0], [2.0], [4.0], [8.0], [16.0]])
    assert tracking(rows)(PAIRS).value[0] == 2 + 4 + 8
    assert tracking(rows, start_time=100.0)(PAIRS).value[0] == 2 + 4 + 8
    assert tracking(rows).starting_at(TWO, time=1.0)(PAIRS).value[0] == 4 + 8 + 16
    with pytest.raises(ValueError, match="references has 5 rows, from time 0 to 4, but is needed"):
        tracking(rows).starting_at(TWO, time=2.0)(PAIRS)


# -- bad input, and warnings ---------------------------------------------------------------


def test_a_model_that_is_not_fitted_is_named():
    for model in (TrajectoryRegressor(), FrozenEstimator(TrajectoryRegressor())):
        with pytest.raises(NotFittedError, match="TrajectoryRegressor"):
            objective(model)


def test_a_horizon_beyond_training_is_said_once_and_a_divergence_never(drift):
    far = objective(drift, horizon=40)
    with pytest.warns(HorizonWarning):
        far(THETA)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        far(THETA)
        far.starting_at([0.0])(THETA)
        assert (objective(drift, initial_states=[1e12])(THETA).value == -np.inf).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": 0}, "horizon = 0"),
        ({"every": 1.5}, "every = 1.5"),
        ({"n_samples": True}, "n_samples = True"),
        ({"risk": "max"}, r"risk = 'max'; choose one of \['mean', 'expected', 'lcb'\]"),
        ({"decision": "gains"}, "decision = 'gains'"),
        ({"decision": "actions"}, "fitted without actions"),
        ({"kappa": -1.0}, "kappa = -1.0"),
        ({"dt": 0.0}, "dt = 0.0"),
        ({"is_terminal": affine}, "needs terminal_reward="),
        ({"initial_states": [np.nan]}, "initial_states has NaN"),
        ({"initial_states": np.zeros((0, 1))}, r"initial_states has shape \(0, 1\)"),
    ],
)
def test_a_wrong_setting_is_named(drift, settings, message):
    with pytest.raises(ValueError, match=message):
        objective(drift, **settings)


@pytest.mark.parametrize(
    ("settings", "candidates", "message"),
    [
        ({}, [[1.0, 2.0]], "2 params"),
        ({}, [1.0, 2.0], r"shape \(2,\); expected \(m, p\)"),
        ({}, np.zeros((0, 1)), r"shape \(0, 1\)"),
        ({}, [[np.nan]], "candidates have NaN"),
        ({"initial_states": [0.0, 0.0]}, [[1.0]], r"initial_states has shape \(1, 2\)"),
        ({"reward": lambda s: s[..., 0] * np.nan}, [[1.0]], "returned NaN"),
        ({"reward": lambda s: s}, [[1.0]], "one number a state"),
        ({"is_terminal": affine, "terminal_reward": 0.0}, [[1.0]], "is_terminal returned float64"),
        (
            {"is_terminal": lambda s: s[2] > 9, "terminal_reward": 0.0},
            [[1.0]],
            r"is_terminal cannot index.*write states\[..., 0\]",
        ),
    ],
)
def test_a_wrong_candidate_or_function_is_named(drift, settings, candidates, message):
    with pytest.raises(ValueError, match=message):
        objective(drift, **settings)(candidates)


def test_a_constraint_answers_yes_or_no(gaussian):
    with pytest.raises(ValueError, match="constraint returned float64"):
        objective(gaussian, constraint=affine)(THETA)


def test_a_model_that_does_not_know_params_has_nothing_to_search():
    ds = drifting()
    blind = TrajectoryRegressor(LinearRegression()).fit(
        TrajectoryDataset.from_arrays([e.states for e in ds], dt=DT)
    )
    with pytest.raises(ValueError, match="without params"):
        objective(blind)
    with pytest.raises(TypeError, match="predicts ndarray, not a Forecast"):
        objective(OnlyMeans())(THETA)


class OnlyMeans:
    """Not a dynamics estimator."""

    def predict(self, X):
        return np.zeros(len(X))
