import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import qmc
from sklearn.base import clone

from tests.control.plants import BOUNDS, HORIZON, Plant, contents, cost, fly, same_contents
from trajlearn import Cartpole, Trajectory, TrajectoryDataset
from trajlearn.control.random_search import RandomSearch
from trajlearn.control.search import Proposal, Search
from trajlearn.exceptions import InvalidEpisodeError, MissingFieldError, MixedSamplingError

GOOD = np.array([0.9, 0.4])


def search_of(**settings):
    return RandomSearch(
        **{"bounds": BOUNDS, "reward": cost, "horizon": HORIZON, "random_state": 0} | settings
    )


def asked(search, n):
    """Params of n trials in a row."""
    found = []
    for _ in range(n):
        found.append(search.ask())
        search.tell(fly(found[-1]))
    return np.array(found)


# -- asking -----------------------------------------------------------------------------------


def test_the_first_proposals_are_the_sobol_points_of_the_seed():
    search = search_of()
    found = asked(search, 4)
    low, high = np.transpose(BOUNDS)
    expected = qmc.Sobol(2, rng=np.random.default_rng(search.seed_)).random(4)
    assert_allclose(found, low + (high - low) * expected)
    assert_array_equal(found, asked(search_of(), 4))
    assert (np.abs(found - asked(search_of(random_state=1), 4)) > 1e-6).all()


def test_bounds_are_where_points_are_drawn():
    other = asked(search_of(bounds=[[3.0, 3.1], [-7.0, -6.0]]), 8)
    assert ((other >= [3.0, -7.0]) & (other <= [3.1, -6.0])).all()


def test_asking_again_gives_the_same_proposal_and_no_way_to_change_it():
    search = search_of()
    first = search.ask()
    first += 100.0
    second = search.ask()
    assert_array_equal(second, search.ask())
    assert_array_equal(second, asked(search_of(), 1)[0])


def test_logged_trials_do_not_use_up_points():
    search = search_of().tell([fly(GOOD), fly(GOOD + 0.1)])
    assert_array_equal(asked(search, 3), asked(search_of(), 3))


# -- telling ----------------------------------------------------------------------------------


def test_the_return_is_the_sum_over_the_horizon_whatever_was_logged_beyond():
    long = fly(GOOD, length=HORIZON + 5)
    search = search_of().tell(long)
    expected = cost(long.states[1 : HORIZON + 1]).sum()
    assert_allclose(search.returns_, [expected])
    assert_allclose(search_of(horizon=2).tell(long).returns_, cost(long.states[1:3]).sum())
    assert search.trials_.lengths.tolist() == [HORIZON + 5]
    assert search.best_reward_ == search.returns_[0]
    assert_array_equal(search.best_params_, GOOD)


def test_the_reward_may_name_signals_or_be_the_logged_one():
    trial = fly(GOOD)
    by_effort = search_of(reward=lambda states, actions: -np.abs(actions).sum(axis=-1))
    assert_allclose(by_effort.tell(trial).returns_, -np.abs(trial.actions).sum())
    assert_allclose(search_of(reward=None).tell(trial).returns_, trial.rewards.sum())
    with pytest.raises(MissingFieldError, match="rewards"):
        search_of(reward=None).tell(Trajectory(trial.states, params=GOOD))


def test_a_return_given_by_hand_stands():
    short = fly(GOOD, length=2)
    assert search_of().tell(short, reward=-3.5).returns_.tolist() == [-3.5]
    assert search_of().tell([short, short], reward=[1, 2]).returns_.tolist() == [1.0, 2.0]


def test_a_crash_is_data_and_each_missing_step_costs_the_least_reward_seen():
    crashed = fly([2.9, 0.5], start=(3.0, 0.0))
    assert crashed.terminated
    assert crashed.length == 1
    missing = HORIZON - 1
    search = search_of().tell(crashed)
    own = cost(crashed.states[1])
    assert_allclose(search.returns_, [own * HORIZON])
    # a worse step in a later trial makes the crash dearer still
    bad = fly([1.9, -0.5], start=(4.5, 4.5))
    worst = cost(bad.states[1:]).min()
    assert worst < own
    assert_allclose(search.tell(bad).returns_[0], own + missing * worst)
    assert_allclose(search_of(terminal_reward=-1.0).tell(crashed).returns_, own - missing)


def test_theta_that_changes_on_the_way_serves_the_model_only():
    trial = fly(GOOD, length=HORIZON + 2)
    theta = np.tile(GOOD, (HORIZON + 2, 1))
    theta[3:] += 0.1
    changing = Trajectory(trial.states, actions=trial.actions, params=theta, dt=0.1)
    search = search_of().tell(changing)
    assert np.isnan(search.returns_).all()
    assert len(search.trials_) == 1
    with pytest.raises(AttributeError, match="no trial with a return"):
        search.best_params_  # noqa: B018
    assert np.isnan(search.history()["best"]).all()
    search.tell(fly(GOOD))
    assert search.best_reward_ == search.returns_[1]
    assert search.history()["best"].tolist()[1] == search.best_reward_
    with pytest.raises(ValueError, match="no theta that its return belongs to"):
        search.tell(changing, reward=1.0)
    # what happens after the horizon does not matter
    theta[:HORIZON] = GOOD
    late = Trajectory(trial.states, actions=trial.actions, params=theta, dt=0.1)
    assert np.isfinite(search_of().tell(late).returns_).all()


def test_a_trial_without_params_ran_the_proposal():
    search = search_of()
    gains = search.ask()
    trial = fly(gains)
    search.tell(Trajectory(trial.states, dt=0.1))
    assert_array_equal(search.trials_.params, [gains])
    assert search.history()["source"].tolist() == ["sobol"]
    with pytest.raises(MissingFieldError, match=r"ask\(\) first"):
        search.tell(Trajectory(trial.states, dt=0.1))


def test_trials_of_other_gains_than_proposed_count_as_logged():
    search = search_of()
    gains = search.ask()
    outside = np.array([-40.0, 3.0])
    # a controller that keeps its gains in single precision
    rounded = gains.astype(np.float32).astype(float)
    search.tell([fly(rounded), fly(outside)])
    assert search.history()["source"].tolist() == ["sobol", "logged"]
    assert_array_equal(search.trials_.params, [rounded, outside])


def test_names_come_from_the_trials_that_have_them():
    named = Plant().rollout(np.ones((1, 2)), GOOD[None], HORIZON)
    search = search_of().tell(named).tell(fly(GOOD)).tell(named)
    assert search.trials_.state_names == ("x", "y")
    assert search.history().columns[:3].tolist() == ["trial", "k_x", "k_y"]
    assert search.trials_.ids.tolist() == [0, 1, 2]
    swapped = TrajectoryDataset([fly(GOOD)], state_names=["y", "x"], param_names=["k_x", "k_y"])
    with pytest.raises(ValueError, match="state_names"):
        search.tell(swapped)


def test_rewards_and_groups_of_a_few_trials_do_not_hinder():
    plain = Trajectory(fly(GOOD).states, params=GOOD, actions=fly(GOOD).actions, dt=0.1)
    for trials in ([fly(GOOD), plain], [plain, fly(GOOD)]):
        search = search_of()
        for trial in trials:
            search.tell(trial)
        assert_allclose(search.returns_[0], search.returns_[1])


# -- errors leave the search as it was ----------------------------------------------------------


def nan_where_small(states):
    return np.where(np.abs(states[..., 0]) < 0.05, np.nan, cost(states))


def broken(states):
    raise RuntimeError("the reward function broke")


WRONG = {
    "state": (lambda: Trajectory(np.ones((7, 3)), params=GOOD, dt=0.1), "3 states a step"),
    "params": (lambda: Trajectory(np.ones((7, 2)), params=[1.0], dt=0.1), "1 params, bounds= says"),
    "dt": (lambda: Trajectory(np.ones((7, 2)), params=GOOD, dt=0.2), "time step of 0.2"),
    "varying dt": (
        lambda: Trajectory(np.ones((7, 2)), params=GOOD, times=np.arange(7.0) ** 2),
        "varies inside",
    ),
    "no actions": (lambda: Trajectory(np.ones((7, 2)), params=GOOD, dt=0.1), "action_names"),
    "short": (lambda: fly(GOOD, length=4), "4 steps, fewer than the horizon of 6"),
    "one of two": (lambda: [fly(GOOD), fly(GOOD, length=4)], "trial 2 has 4 steps"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_trial_changes_nothing(kind, tmp_path):
    make, message = WRONG[kind]
    search = search_of().tell(fly(GOOD))
    search.ask()
    before = contents(search, tmp_path)
    with pytest.raises(ValueError, match=message):
        search.tell(make())
    assert same_contents(contents(search, tmp_path), before)
    search.tell(fly(search.ask()))
    assert len(search.returns_) == 2


@pytest.mark.parametrize(
    ("reward", "error", "message"),
    [
        (nan_where_small, ValueError, "returned NaN"),
        (broken, RuntimeError, "function broke"),
        (lambda states: cost(states)[..., None], ValueError, "returned shape"),
        (lambda states: cost(states) / 0.0, ValueError, "trial 1: a step has the reward -inf"),
    ],
    ids=["nan", "raises", "shape", "infinite"],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_a_reward_that_fails_changes_nothing(reward, error, message, tmp_path):
    search = search_of().tell(fly(GOOD))
    search.ask()
    before = contents(search, tmp_path)
    search.set_params(reward=reward)
    with pytest.raises(error, match=message):
        search.tell(fly(GOOD))
    search.set_params(reward=cost)
    assert same_contents(contents(search, tmp_path), before)


@pytest.mark.parametrize(
    ("given", "message"),
    [(np.nan, "must be finite"), ([1.0, 2.0], "shape"), ([[1.0]], "shape"), ("well", "convert")],
    ids=["nan", "two", "nested", "text"],
)
def test_a_wrong_return_changes_nothing(given, message, tmp_path):
    search = search_of().tell(fly(GOOD))
    before = contents(search, tmp_path)
    with pytest.raises(ValueError, match=message):
        search.tell(fly(GOOD), reward=given)
    assert same_contents(contents(search, tmp_path), before)


def test_what_is_no_trajectory_says_so():
    with pytest.raises(TypeError, match="TrajectoryDataset"):
        search_of().tell(np.zeros((7, 2)))
    with pytest.raises(InvalidEpisodeError):
        search_of().tell(Trajectory([[0.0, np.nan], [0.0, 0.0]], params=GOOD))
    with pytest.raises(MixedSamplingError):
        search_of().tell(Trajectory(np.ones((7, 2)), params=GOOD, times=np.arange(7.0) ** 2))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bounds": [[0.0, 2.0], [1.5, -0.5]]}, "lower bound"),
        ({"bounds": [[0.0, 2.0], [1.0, 1.0]]}, "lower bound"),
        ({"bounds": [[0.0, np.inf], [0.0, 1.0]]}, "finite"),
        ({"bounds": [[0.0, np.nan], [0.0, 1.0]]}, "finite"),
        ({"bounds": [0.0, 1.0]}, "shape"),
        ({"bounds": np.transpose([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])}, "shape"),
        ({"bounds": np.empty((0, 2))}, "shape"),
        ({"horizon": 0}, "horizon"),
        ({"horizon": 2.5}, "horizon"),
        ({"reward": "cost"}, "reward"),
        ({"terminal_reward": np.inf}, "terminal_reward"),
        ({"random_state": "seed"}, "random_state"),
    ],
    ids=str,
)
def test_impossible_settings_are_named_and_change_nothing(settings, message, tmp_path):
    for action in (lambda s: s.ask(), lambda s: s.tell(fly(GOOD))):
        with pytest.raises(ValueError, match=message):
            action(search_of(**settings))
    running = search_of().tell(fly(GOOD))
    running.ask()
    before, good = contents(running, tmp_path), running.get_params()
    running.set_params(**settings)
    if "random_state" not in settings:
        with pytest.raises(ValueError, match=message):
            running.ask()
    with pytest.raises(ValueError, match=message):
        running.tell(fly(GOOD))
    running.set_params(**good)
    assert same_contents(contents(running, tmp_path), before)


def test_bounds_and_horizon_stay_what_they_were():
    search = search_of().tell(fly(GOOD))
    with pytest.raises(ValueError, match=r"bounds = \[\[0.0, 1.0\].*here"):
        search.set_params(bounds=[[0.0, 1.0], [0.0, 1.0]]).ask()
    with pytest.raises(ValueError, match="p = 1 here, 2 there; horizon = 3 here, 6 there"):
        search.set_params(bounds=[[0.0, 1.0]], horizon=3).tell(fly(GOOD))


class Scripted(Search):
    """Proposes what a list says."""

    def __init__(self, *, bounds, reward=None, horizon, n_initial=2, script=(), random_state=None):
        self.bounds, self.reward, self.horizon = bounds, reward, horizon
        self.n_initial, self.script, self.random_state = n_initial, script, random_state
        self.terminal_reward, self.verbose = None, 0

    def _propose(self, rng):
        params, returns = self._tried()
        self.seen = (params, returns, rng.random())
        return Proposal(np.array(self.script[len(returns) - self.n_initial]), reward=1.5, std=0.5)


def test_after_the_initial_trials_the_subclass_proposes(tmp_path):
    search = Scripted(
        bounds=BOUNDS, reward=cost, horizon=HORIZON, script=[[1.0, 0.5], [9.0, np.nan]]
    )
    first = asked(search, 2)
    assert search.history()["source"].tolist() == ["sobol"] * 2
    assert_array_equal(search.ask(), [1.0, 0.5])
    assert_array_equal(search.seen[0], first)
    assert_array_equal(search.seen[1], search.returns_)
    # ask number 2 draws from the stream of (seed, 2)
    assert search.seen[2] == np.random.default_rng([search.seed_, 2]).random()
    search.tell(fly([1.0, 0.5]))
    last = search.history().iloc[-1]
    assert (last["source"], last["predicted"], last["predicted_std"]) == ("model", 1.5, 0.5)
    assert last["return"] == 0.0 == last["best"] == search.best_reward_
    before = contents(search, tmp_path)
    with pytest.raises(ValueError, match="found no parameters"):
        search.ask()
    assert same_contents(contents(search, tmp_path), before)


def test_a_proposal_never_leaves_the_bounds():
    search = Scripted(
        bounds=BOUNDS, reward=cost, horizon=HORIZON, n_initial=1, script=[[2.0 + 1e-12, 0.5]]
    )
    asked(search, 1)
    assert search.ask()[0] == 2.0


# -- history ----------------------------------------------------------------------------------


def test_history_has_one_row_a_trial():
    search = search_of()
    asked(search, 3)
    search.tell(fly([2.9, 0.5], start=(3.0, 0.0)))
    table = search.history()
    assert table.columns.tolist() == [
        "trial",
        "theta0",
        "theta1",
        "return",
        "best",
        "predicted",
        "expected",
        "predicted_std",
        "violation",
        "n_steps",
        "terminated",
        "source",
    ]
    assert_array_equal(table["return"], search.returns_)
    assert_array_equal(table["best"], np.maximum.accumulate(search.returns_))
    assert table["n_steps"].tolist() == [6, 6, 6, 1]
    assert table["terminated"].tolist() == [False, False, False, True]
    assert_array_equal(table[["theta0", "theta1"]], search.trials_.params)


def test_before_the_first_trial_there_is_nothing_to_show():
    search = search_of()
    for name in ("trials_", "returns_", "best_params_", "best_reward_", "seed_"):
        if name != "best_params_":
            assert not hasattr(search, name), name
    with pytest.raises(AttributeError, match=r"ask\(\)"):
        search.history()
    search.ask()
    assert search.returns_.shape == (0,)
    with pytest.raises(AttributeError, match="no trial was told"):
        search.trials_  # noqa: B018


def test_a_clone_starts_anew():
    search = search_of()
    found = asked(search, 2)
    assert_array_equal(asked(clone(search), 2), found)


# -- running a simulator ----------------------------------------------------------------------


def test_run_is_ask_rollout_tell():
    env, search = Plant(), search_of()
    assert search.run(env, 3) is search
    assert_array_equal([flown[1] for flown in env.flown], asked(search_of(), 3))
    assert all(flown[2] == HORIZON for flown in env.flown)
    assert_allclose(
        search.returns_,
        [cost(fly(params, start).states[1:]).sum() for start, params, *_ in env.flown],
    )
    search.run(env, 2)
    assert len(search.returns_) == 5
    assert len({flown[4] for flown in env.flown}) == 5


def test_searches_of_a_seed_meet_the_same_trials():
    one, other = Plant(), Plant()
    search_of().run(one, 3)
    search_of().tell([fly(GOOD)]).run(other, 3)
    for a, b in zip(one.flown, other.flown, strict=True):
        assert_array_equal(a[0], b[0])
        assert a[4] == b[4]


def test_run_takes_first_states_in_turn_and_a_policy():
    env = Plant()
    starts = np.array([[1.0, 0.0], [0.0, 1.0]])
    search_of().run(env, 3, initial_states=starts, policy=cost)
    assert_array_equal([flown[0] for flown in env.flown], starts[[0, 1, 0]])
    assert env.flown[0][3] is cost
    search_of().run(env, 1, initial_states=starts[0])
    assert_array_equal(env.flown[-1][0], starts[0])


class Failing(Plant):
    def rollout(self, *args, **kwargs):
        if len(self.flown) == 2:
            raise OSError("the simulator went away")
        return super().rollout(*args, **kwargs)


def test_a_crashed_evaluation_comes_through_with_a_note_and_the_proposal_waits(tmp_path):
    search, env = search_of(), Failing()
    with pytest.raises(OSError, match="went away") as caught:
        search.run(env, 5)
    assert "trial 2" in caught.value.__notes__[0]
    assert len(search.returns_) == 2
    expected = asked(search_of(), 3)
    assert_array_equal(search.ask(), expected[2])
    assert str(expected[2].tolist()) in caught.value.__notes__[0]
    before = contents(search, tmp_path)
    with pytest.raises(OSError):
        search.run(env, 1)
    assert same_contents(contents(search, tmp_path), before)


@pytest.mark.parametrize("n_trials", [0, -1, 2.5])
def test_run_wants_a_number_of_trials(n_trials):
    with pytest.raises((ValueError, TypeError), match="n_trials"):
        search_of().run(Plant(), n_trials)


def test_run_shows_its_progress_if_asked_to(capfd):
    search_of().run(Plant(), 2)
    assert capfd.readouterr().err == ""
    search_of(verbose=1).run(Plant(), 2)
    assert "2/2" in capfd.readouterr().err


def test_run_drives_the_simulators_of_the_package():
    env = Cartpole()
    search = RandomSearch(bounds=env.param_bounds, horizon=20, random_state=0).run(env, 3)
    assert search.trials_.param_names == env.param_names
    assert_allclose(
        RandomSearch(bounds=env.param_bounds, reward=env.reward, horizon=20, random_state=0)
        .run(env, 3)
        .returns_,
        search.returns_,
    )
