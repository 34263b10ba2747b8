"""MPC: on systems that are known exactly, what it decides, when, and what it logs."""

import pickle
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import DotProduct, WhiteKernel
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from trajlearn.control import _planner
from trajlearn.control.mpc import MPC
from trajlearn.dynamics import OneStepRegressor, TrajectoryRegressor
from trajlearn.envs import Cartpole, Reacher
from trajlearn.envs.base import Environment
from trajlearn.policies import LinearFeedback
from trajlearn.trajectories import SubtrajectoryRelabeler
from trajlearn.trajectories.params import ParamsTransformer

GAINS = [[0.0, 4.0], [0.0, 4.0]]
STARTS = np.array([[1.0, 0.0], [-0.5, 0.5]])


def cost(states):
    return -(states[..., 0] ** 2) - 0.1 * states[..., 1] ** 2


@dataclass(frozen=True)
class DoubleIntegrator(Environment):
    """A cart on rails that a force pushes; `push` is a force that no model knows of."""

    push: float = 0.0
    limit: float = np.inf

    state_names = ("x", "v")
    action_names = ("u",)
    param_names = ("k_x", "k_v")
    redraw_terminated = False
    dt = 0.1

    @property
    def policy(self):
        return LinearFeedback()

    @property
    def action_bounds(self):
        return np.array([[-1.0, 1.0]])

    @property
    def param_bounds(self):
        return np.array(GAINS)

    def reward(self, states):
        return cost(np.asarray(states))

    def is_terminal(self, states):
        return np.abs(np.asarray(states)[..., 0]) > self.limit

    def _draw_initial_state(self, generator):
        return generator.uniform(-1, 1, size=2)

    def _draw_params(self, generator):
        return generator.uniform(*self.param_bounds.T)

    def _step(self, states, actions):
        x, v = states.T
        v = v + self.dt * (actions[:, 0] + self.push)
        return np.stack([x + self.dt * v, v], axis=1)


ENV = DoubleIntegrator()


@pytest.fixture(scope="module")
def exact():
    """A one-step model that is right about the double integrator."""
    return OneStepRegressor(LinearRegression(), policy=ENV.policy).fit(
        ENV.collect(5, 30, random_state=0)
    )


@pytest.fixture(scope="module")
def trajectory():
    """A trajectory model, good enough to plan with."""
    model = TrajectoryRegressor(random_state=0).set_params(estimator__max_steps=400)
    return model.fit(ENV.collect(40, 30, random_state=0))


def mpc(model, **changes):
    settings = {"bounds": GAINS, "reward": cost, "horizon": 20, "n_candidates": 60}
    if changes.get("decision") == "actions":
        settings["bounds"] = [[-1.0, 1.0]]
    return MPC(model, **{**settings, "random_state": 0, **changes})


@pytest.fixture
def asked(monkeypatch):
    """Batches of candidates, and settings of the objective, by decision."""
    seen = []

    class Spy(_planner.PredictedReturn):
        def __init__(self, model, **settings):
            super().__init__(model, **settings)
            self.seen = []
            seen.append(SimpleNamespace(batches=self.seen, **settings))

        def __call__(self, candidates):
            self.seen.append(candidates.copy())
            return super().__call__(candidates)

    monkeypatch.setattr(_planner, "PredictedReturn", Spy)
    return seen


def returns(ds):
    return np.array([episode.rewards.sum() for episode in ds])


# -- what it decides ----------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["random", "cem", "cma"])
def test_gains_planned_with_an_exact_model_earn_what_was_predicted(exact, optimizer):
    planner = mpc(exact, hold="all", optimizer=optimizer, horizon=30, n_candidates=150)
    trials = planner.run(ENV, STARTS, 30)
    np.testing.assert_allclose(planner.decisions_["value"], returns(trials), rtol=1e-9)
    axis = np.linspace(0, 4, 9)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    for i, start in enumerate(STARTS):
        flown = returns(ENV.rollout(np.tile(start, (81, 1)), grid, 30))
        assert returns(trials)[i] > flown.max() - 0.02 * np.ptp(flown)
    assert np.abs(np.stack([t.states[-1] for t in trials])).max() < 0.1


def test_trajectory_model_plans_better_than_chance(trajectory):
    planner = mpc(trajectory, hold="all", horizon=30, n_candidates=200, optimizer="cem")
    trials = planner.run(ENV, STARTS, 30)
    theta = np.random.default_rng(0).uniform(0, 4, size=(200, 2))
    flown = [returns(ENV.rollout(np.tile(start, (200, 1)), theta, 30)) for start in STARTS]
    assert returns(trials).sum() > np.quantile(np.sum(flown, axis=0), 0.6)


def test_closing_the_loop_pays_under_a_push_that_no_model_knows_of(exact):
    pushed = DoubleIntegrator(push=0.4)
    settings = {"decision": "actions", "optimizer": "cem", "n_candidates": 200, "horizon": 12}
    of = {
        hold: returns(mpc(exact, hold=hold, **settings).run(pushed, STARTS, 12)).sum()
        for hold in ("all", 4, 1)
    }
    assert of[1] > of[4] > of["all"]
    # without it, an exact model loses nothing by being believed to the end
    planner = mpc(exact, hold="all", **settings)
    trials = planner.run(ENV, STARTS, 12)
    np.testing.assert_allclose(planner.decisions_["value"], returns(trials), rtol=1e-9)


def test_actions_of_the_plan_are_the_actions_of_the_trial(exact):
    planner = mpc(exact, decision="actions", hold="all", horizon=8)
    trial = planner.run(ENV, STARTS[0], 8)
    plan = mpc(exact, decision="actions", hold="all", horizon=8).plan(STARTS[0])
    np.testing.assert_array_equal(plan.actions, trial[0].actions)
    assert plan.params is None
    assert not trial.has_params


def test_planning_reaches_as_far_as_the_trial_unless_told_otherwise(exact, asked):
    mpc(exact, horizon=6, hold=3, n_candidates=5).run(ENV, STARTS[0], 10)
    assert [it.horizon for it in asked] == [6, 6, 4, 1]
    asked.clear()
    mpc(exact, horizon=6, hold=3, n_candidates=5, beyond_end=True).run(ENV, STARTS[0], 10)
    assert [it.horizon for it in asked] == [6] * 4
    asked.clear()
    mpc(exact, horizon=6, n_candidates=5).plan(STARTS[0], horizon=2)
    assert asked[0].horizon == 2


def test_rewards_of_every_kth_step_make_about_the_same_decision(exact):
    plans = {k: mpc(exact, horizon=30, every=k, n_candidates=400).plan(STARTS[0]) for k in (1, 5)}
    assert plans[5].value == pytest.approx(plans[1].value, rel=0.05)
    assert plans[5].value != plans[1].value
    np.testing.assert_allclose(plans[5].params, plans[1].params, atol=1.0)


def test_terminal_rewards_keep_it_away_from_the_edge(exact):
    def edge(states):
        return states[..., 0] < 0.0

    plans = [
        mpc(exact, horizon=40, n_candidates=300, is_terminal=edge, terminal_reward=price).plan(
            STARTS[0]
        )
        for price in (0.0, -10.0)
    ]
    lowest = [ENV.rollout(STARTS[:1], plan.params, 40).states[:, 0].min() for plan in plans]
    # an end that costs nothing is sought, one that costs is avoided
    assert lowest[0] < 0 <= lowest[1] + 1e-9


def test_lower_confidence_bound_is_another_objective(asked):
    noisy = TrajectoryRegressor(random_state=0)
    noisy.set_params(estimator__max_steps=30, estimator__n_members=3)
    noisy.fit(ENV.collect(10, 20, random_state=0))
    plans = [
        mpc(noisy, risk=risk, kappa=kappa, n_samples=5, n_candidates=20, horizon=10).plan(STARTS[0])
        for risk, kappa in (("mean", 1.0), ("lcb", 1.0), ("lcb", 2.0))
    ]
    assert plans[0].value > plans[1].value > plans[2].value
    expected, bound = (
        mpc(noisy, n_samples=5, n_candidates=20, horizon=10, **risk).plan(STARTS[0])
        for risk in ({"risk": "expected"}, {"risk": "lcb", "kappa": 0.0})
    )
    assert expected.value == bound.value > plans[1].value
    np.testing.assert_array_equal(expected.params, bound.params)


# -- the constraint -----------------------------------------------------------------------


def test_constraint_is_kept_in_the_plan():
    def slow(states):
        return np.abs(states[..., 1]) < 0.4

    learner = GaussianProcessRegressor(DotProduct() + WhiteKernel(1e-6), optimizer=None)
    model = OneStepRegressor(learner, policy=ENV.policy).fit(ENV.collect(3, 20, random_state=0))
    free = mpc(model, horizon=30).plan(STARTS[0])
    bound = mpc(model, horizon=30, constraint=slow, n_samples=2).plan(STARTS[0])
    fastest = [
        np.abs(ENV.rollout(STARTS[:1], plan.params, 30).states[:, 1]).max()
        for plan in (free, bound)
    ]
    assert fastest[1] < 0.4 < fastest[0]
    assert bound.violation == 0
    never = mpc(model, constraint=lambda s: s[..., 0] > 5, n_samples=2).plan(STARTS[0])
    assert never.violation == 1


# -- when, and from what ------------------------------------------------------------------


@pytest.mark.parametrize("hold", [1, 4, 7])
def test_theta_changes_at_multiples_of_hold_only(exact, hold):
    planner = mpc(exact, hold=hold, n_candidates=20, warm_start=False)
    trials = planner.run(ENV, STARTS, 15)
    assert trials.param_names == ENV.param_names
    for trial in trials:
        changed = np.flatnonzero((np.diff(trial.params, axis=0) != 0).any(axis=1)) + 1
        assert changed.tolist() == list(range(hold, 15, hold))
        for t, (state, action) in enumerate(zip(trial.states, trial.actions, strict=False)):
            want = ENV.policy(state[None], trial.params[t : t + 1], np.zeros(1))
            np.testing.assert_array_equal(action, want[0])
    n = -(-15 // hold)
    table = planner.decisions_
    assert table["step"].tolist() == 2 * list(range(0, 15, hold))
    assert table["trial"].tolist() == [0] * n + [1] * n
    assert (table["seconds"] > 0).all()


def test_held_to_the_end_theta_is_one_for_the_trial(exact):
    for hold in ("all", 15, 99):
        trials = mpc(exact, hold=hold, n_candidates=20).run(ENV, STARTS, 15)
        assert not trials.params_vary
        assert trials.params.shape == (2, 2)


def test_candidates_are_fresh_at_each_decision_and_the_seed_repeats_them(exact, asked):
    planner = mpc(exact, hold=5, n_candidates=10, warm_start=False)
    planner.run(ENV, STARTS, 10)
    first = [it.batches[0] for it in asked]
    assert len(first) == 4
    assert all(len(it.batches) == 1 for it in asked)
    assert len(np.unique(np.concatenate(first), axis=0)) == 40
    asked.clear()
    planner.run(ENV, STARTS, 10)
    np.testing.assert_array_equal(first, [it.batches[0] for it in asked])
    asked.clear()
    mpc(exact, hold=5, n_candidates=10, warm_start=False, random_state=1).run(ENV, STARTS, 10)
    assert not np.isin(asked[0].batches[0], first[0]).any()


@pytest.mark.parametrize("optimizer", ["random", "cem", "cma"])
@pytest.mark.parametrize("decision", ["params", "actions"])
def test_same_seed_same_bits(exact, optimizer, decision):
    settings = {"optimizer": optimizer, "decision": decision, "hold": 3, "horizon": 8}
    runs = [mpc(exact, **settings).run(ENV, STARTS, 9) for _ in range(2)]
    assert runs[0] == runs[1]


@pytest.mark.parametrize("optimizer", ["random", "cem", "cma"])
def test_warm_start_begins_with_the_theta_before(exact, asked, optimizer):
    planner = mpc(exact, optimizer=optimizer, n_candidates=70, hold=2)
    before = planner.plan(STARTS[0])
    planner.plan(STARTS[0])
    np.testing.assert_array_equal(asked[1].batches[0][0], before.params)
    assert sum(map(len, asked[1].batches)) == 70
    # in one batch with others, as a roll-out of one takes as long
    assert len(asked[1].batches[0]) > 1
    planner.reset().plan(STARTS[0])
    assert not (asked[2].batches[0][0] == before.params).any()
    asked.clear()
    cold = mpc(exact, optimizer=optimizer, n_candidates=70, hold=2, warm_start=False)
    before = cold.plan(STARTS[0])
    cold.plan(STARTS[0])
    assert not (asked[1].batches[0][0] == before.params).any()


def test_warm_start_moves_actions_on_by_the_steps_held(exact, asked):
    planner = mpc(exact, decision="actions", hold=3, horizon=5, n_candidates=20)
    first = planner.plan(STARTS[0]).actions
    planner.plan(STARTS[0])
    want = first[[3, 4, 4, 4, 4]]
    np.testing.assert_array_equal(asked[1].batches[0][0], want)
    planner.act(STARTS[0])
    second = planner.act(STARTS[0])
    again = planner.plan(STARTS[0])
    # the third action of what was planned before is the next one
    before = asked[1].batches[0]
    (row,) = np.flatnonzero(before[:, 1] == second)
    np.testing.assert_array_equal(asked[2].batches[0][0], before[row][[2, 3, 4, 4, 4]])
    assert again.actions.shape == (5, 1)
    asked.clear()
    planner.run(ENV, STARTS[0], 7)
    # the trial ends: three actions are left of the second plan, and one is to be found
    assert [it.batches[0].shape for it in asked] == [(20, 5, 1), (20, 4, 1), (20, 1, 1)]


def test_a_robot_driven_by_hand_goes_the_same_way(exact):
    planner = mpc(exact, hold=4, n_candidates=30, beyond_end=True)
    trials = planner.run(ENV, STARTS, 10)
    by_hand = mpc(exact, hold=4, n_candidates=30)
    for trial, start in zip(trials, STARTS, strict=True):
        state = start
        by_hand.reset()
        for t in range(10):
            action = by_hand.act(state, t * ENV.dt)
            np.testing.assert_array_equal(action, trial.actions[t])
            state = ENV.step(state[None], action[None])[0]
            np.testing.assert_array_equal(state, trial.states[t + 1])
    cols = ["trial", "step", "value"]
    assert by_hand.decisions_[cols].equals(planner.decisions_[cols])


def test_policy_is_planned_with_at_the_time_of_the_trial(exact):
    times = []

    def later(states, params, t):
        times.append(t)
        return ENV.policy(states, params, t)

    planner = mpc(exact, policy=later, horizon=4, hold=3, n_candidates=5)
    planner.run(ENV, STARTS[0], 5)
    planned = [float(t[0]) for t in times if len(t) == 5]
    np.testing.assert_allclose(planned, [0.0, 0.1, 0.2, 0.3, 0.3, 0.4], atol=1e-12)
    acted = [float(t[0]) for t in times if len(t) == 1]
    np.testing.assert_allclose(acted, [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-12)


@dataclass(frozen=True)
class Windy(DoubleIntegrator):
    """The same with a random force at each step."""

    def _disturbed(self, states, generators):
        return states + [[0.0, 0.1 * generator.normal()] for generator in generators]


def test_noise_of_the_simulator_has_a_seed_of_its_own(exact):
    def fly(seed, **changes):
        return mpc(exact, hold="all", n_candidates=5, **changes).run(
            Windy(), STARTS[[0, 0]], 5, random_state=seed
        )

    first = fly(1)
    assert fly(1) == first
    gusts = [episode.states[:, 1] for episode in first]
    assert not np.allclose(np.diff(gusts[0]), np.diff(gusts[1]))
    assert (fly(2).states[1] != first.states[1]).any()
    assert fly(2)[0].params.tolist() == first[0].params.tolist()
    # the planner's own seed tells, if nobody else does
    assert fly(None) == fly(None)
    assert (fly(None, random_state=1).states != fly(None).states).any()


def test_a_planner_can_be_stopped_and_go_on(exact):
    planner, other = mpc(exact, hold=2, n_candidates=20), mpc(exact, hold=2, n_candidates=20)
    state = STARTS[0]
    for _ in range(5):
        action = planner.act(state)
        np.testing.assert_array_equal(action, other.act(state))
        other = pickle.loads(pickle.dumps(other))
        state = ENV.step(state[None], action[None])[0]


def test_hidden_state_of_a_simulator_is_kept_during_a_trial():
    env = Reacher()
    model = TrajectoryRegressor(LinearRegression(), random_state=0)
    model.fit(env.collect(4, 30, random_state=0))
    planner = MPC(
        model, bounds=env.param_bounds, reward=env.reward, horizon=40, hold="all",
        n_candidates=20, random_state=0,
    )  # fmt: skip
    start = env.reset(1, random_state=1)
    with pytest.warns(UserWarning, match="ahead"):
        trial = planner.run(env, start, 40)
    want = env.rollout(start, trial.params, 40)
    np.testing.assert_array_equal(trial.states, want.states)
    assert trial.param_names == env.param_names


def test_trial_that_ends_early_is_data():
    env = Cartpole()
    model = OneStepRegressor(LinearRegression(), policy=env.policy)
    model.fit(env.collect(5, 40, random_state=0))
    planner = MPC(
        # the wrong way round: as far out as it can
        model, bounds=-env.param_bounds[:, ::-1], reward=lambda s: s[..., 2] ** 2,
        horizon=20, hold=5, n_candidates=10, warm_start=False, random_state=0,
    )  # fmt: skip
    trials = planner.run(env, env.reset(2, random_state=0), 300)
    assert trials.terminated.all()
    assert (trials.lengths < 300).all()
    assert [len(t.params) for t in trials] == trials.lengths.tolist()


# -- data gathered while theta changes ----------------------------------------------------


def test_models_learn_from_stretches_of_constant_theta_only(exact):
    hold = 4
    trials = mpc(exact, hold=hold, n_candidates=20, warm_start=False).run(ENV, STARTS, 14)
    relabeler = SubtrajectoryRelabeler(max_rows=None)
    rows, targets = relabeler.fit_resample(trials)
    # 3 stretches of 4 steps and one of 2, with 4 * 5 / 2 and 3 pairs
    assert len(rows) == 2 * (3 * 10 + 3)
    layout = relabeler.layout_
    for row, target, i in zip(rows, targets, relabeler.sample_indices_, strict=True):
        trial = trials[i]
        (begin,) = np.flatnonzero((trial.states == row[layout["state"]]).all(axis=1))
        steps = round(row[layout["horizon"]].item() / ENV.dt)
        np.testing.assert_array_equal(trial.states[begin + steps], target)
        assert begin // hold == (begin + steps - 1) // hold
        np.testing.assert_array_equal(trial.params[begin], row[layout["params"]])
    model = TrajectoryRegressor(LinearRegression(), random_state=0).fit(trials)
    assert model.max_horizon_ == pytest.approx(hold * ENV.dt)
    assert np.isfinite(model.predict(trials).mean[:, :hold]).all()
    # and the old data with the new make one dataset
    both = ENV.collect(5, 14, random_state=0).concatenate(trials)
    assert TrajectoryRegressor(LinearRegression(), random_state=0).fit(both).max_horizon_ > 1


# -- other models -------------------------------------------------------------------------


def log_gains(params):
    return np.log1p(params)


def test_model_in_a_pipeline_is_planned_with():
    ds = ENV.collect(20, 30, random_state=0)
    model = TrajectoryRegressor(LinearRegression(), random_state=0)
    pipe = make_pipeline(ParamsTransformer(log_gains), model).fit(ds)
    plan = mpc(pipe, dt=ENV.dt, horizon=10).plan(STARTS[0])
    theta = np.random.default_rng(0).uniform(0, 4, size=(50, 2))
    settings = {"horizons": ENV.dt * np.arange(1, 11), "params": log_gains(theta)}
    predicted = pipe[-1].predict_trajectory(STARTS[:1], **settings).mean
    assert plan.value > np.quantile(cost(predicted).sum(axis=1), 0.9)
    again = pipe[-1].predict_trajectory(
        STARTS[:1], horizons=settings["horizons"], params=log_gains(plan.params[None])
    )
    assert plan.value == pytest.approx(cost(again.mean).sum())
    trials = mpc(pipe, n_candidates=20, horizon=10, hold=5).run(ENV, STARTS, 10)
    assert trials.param_names == ENV.param_names


# -- what is refused ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bounds": [[1.0, 0.0], [0.0, 1.0]]}, "lower"),
        ({"bounds": [0.0, 1.0]}, "bounds"),
        ({"horizon": 0}, "horizon"),
        ({"hold": "never"}, "hold"),
        ({"decision": "gains"}, "decision"),
        ({"optimizer": "adam"}, "optimizer"),
        ({"risk": "max"}, "risk"),
        ({"reward": 3}, "reward"),
        ({"bounds": [[0.0, 1.0]] * 3}, "params"),
        (
            {"decision": "actions", "bounds": [[-1.0, 1.0]] * 2},
            r"bounds has 2 rows, but OneStepRegressor was fitted with d_a = 1 actions \(u\)",
        ),
        (
            {"decision": "actions", "bounds": [[-1.0, 1.0]], "hold": 21},
            "hold = 21 is more than the horizon = 20",
        ),
        ({"reward": lambda s: np.full(s.shape[:-1], np.nan)}, "NaN"),
        ({"reward": lambda s: np.zeros(3)}, "shape"),
        ({"reward": lambda s: np.full(s.shape[:-1], -np.inf)}, "finite"),
        ({"dt": 0.05}, "dt|horizons|step"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_planned_is_said_and_nothing_is_lost(exact, changes, message):
    planner = mpc(exact, n_candidates=10)
    planner.act(STARTS[0])
    before = planner.decisions_
    good = planner.get_params()
    planner.set_params(**changes)
    with pytest.raises(ValueError, match=message):
        planner.plan(STARTS[0])
    assert planner.decisions_.equals(before)
    planner.set_params(**{key: good[key] for key in changes}).act(STARTS[0])


def test_bounds_of_other_params_than_the_models_are_named(trajectory):
    message = r"bounds has 3 rows, but TrajectoryRegressor was fitted with p = 2 params \(k_x, k_v"
    with pytest.raises(ValueError, match=message):
        mpc(trajectory, bounds=[[0.0, 1.0]] * 3).plan(STARTS[0])
    # what a pipeline makes of params is its own affair
    ds = ENV.collect(5, 9, random_state=0)
    three = ds.assign(params=ds.params[:, [0, 1, 1]])
    to_gains = make_pipeline(
        ParamsTransformer(lambda params: params[:, :2]),
        TrajectoryRegressor(LinearRegression(), random_state=0),
    ).fit(three)
    planner = mpc(to_gains, bounds=[[0.0, 1.0]] * 3, dt=ENV.dt, horizon=5, n_candidates=5)
    assert planner.plan(STARTS[0]).params.shape == (3,)


def test_model_must_suit_what_is_decided(exact, trajectory):
    with pytest.raises(ValueError, match="decision='actions', but TrajectoryRegressor"):
        mpc(trajectory, decision="actions").plan(STARTS[0])
    bare = OneStepRegressor(LinearRegression()).fit(ENV.collect(2, 9, random_state=0))
    with pytest.raises(ValueError, match="needs policy="):
        mpc(bare).plan(STARTS[0])
    mpc(bare, policy=ENV.policy).act(STARTS[0])
    mpc(bare, decision="actions").act(STARTS[0])
    with pytest.raises(NotFittedError):
        mpc(OneStepRegressor(policy=ENV.policy)).plan(STARTS[0])


def test_parameters_need_a_policy_to_act_by_not_to_plan(trajectory):
    planner = mpc(trajectory)
    assert planner.plan(STARTS[0]).params.shape == (2,)
    with pytest.raises(ValueError, match="give policy="):
        planner.act(STARTS[0])
    assert mpc(trajectory, policy=ENV.policy).act(STARTS[0]).shape == (1,)
    odd = mpc(trajectory, policy=lambda s, p, t: np.zeros(3))
    with pytest.raises(ValueError, match="policy returned actions of shape"):
        odd.act(STARTS[0])


@pytest.mark.parametrize("state", [np.zeros((1, 2)), [np.nan, 0.0], [0.0, 0.0, 0.0], 1.0])
def test_wrong_states_are_named(exact, state):
    with pytest.raises(ValueError, match="state"):
        mpc(exact).plan(state)


def test_a_run_that_cannot_begin_loses_no_decisions(exact):
    planner = mpc(exact, n_candidates=10)
    planner.act(STARTS[0])
    before = planner.decisions_
    with pytest.raises(ValueError, match="lower bound must be less"):
        planner.set_params(bounds=[[1.0, 0.0], [0.0, 1.0]]).run(ENV, STARTS, 5)
    assert planner.decisions_.equals(before)


def test_wrong_runs_are_named(exact):
    with pytest.raises(ValueError, match=r"a step of the environment takes 0\.1"):
        mpc(exact, dt=0.2).run(ENV, STARTS, 5)
    with pytest.raises(ValueError, match="length = 0 must be"):
        mpc(exact).run(ENV, STARTS, 0)
    with pytest.raises(ValueError, match="initial_states"):
        mpc(exact).run(ENV, np.zeros((1, 3)), 5)
    with pytest.raises(AttributeError, match="nothing was decided"):
        _ = mpc(exact).decisions_


def test_progress_is_shown_if_asked_for(exact, capsys):
    mpc(exact, n_candidates=5, horizon=3).run(ENV, STARTS, 4)
    assert capsys.readouterr().err == ""
    mpc(exact, n_candidates=5, horizon=3, verbose=1).run(ENV, STARTS, 4)
    assert "8/8" in capsys.readouterr().err
