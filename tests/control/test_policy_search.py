import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import BaseEstimator, clone
from sklearn.exceptions import NotFittedError
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from tests.control.plants import (
    BOUNDS,
    HORIZON,
    OPEN,
    Plant,
    contents,
    cost,
    fallen,
    fly,
    policy,
    same_contents,
    tuned_by_a_model,
)
from tests.control.test_search_file import killed_after_ask
from trajlearn import (
    Cartpole,
    DirectRewardGP,
    Forecast,
    MLPEnsembleRegressor,
    OneStepRegressor,
    Trajectory,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.control.policy_search import PolicySearch
from trajlearn.control.random_search import RandomSearch
from trajlearn.exceptions import HorizonWarning, NoUncertaintyError, UnsafeProposalError

START = (1.0, -1.0)


def linear():
    """Identifies the plant from two gains."""
    return OneStepRegressor(LinearRegression(), policy=policy)


class Believed(BaseEstimator):
    """Knows the plant, and how unsure it is: each member is wrong about it in its own way."""

    def __init__(self, *, doubt=0.0, members=(-1.0, 1.0), shift=0.0, random_state=None):
        self.doubt, self.members, self.shift = doubt, members, shift
        self.random_state = random_state

    def fit(self, X, y=None):
        self.fitted_on_, self.seed_ = X, self.random_state
        return self

    def predict(self, X):
        raise NotImplementedError

    def predict_trajectory(
        self, initial_states, *, params, horizons, policy=None, n_samples=None, random_state=None
    ):
        s = np.asarray(initial_states)
        self.steps_, self.starts_, self.policy_ = len(horizons), s, policy
        # all that is unsure is x, and the more so the greater its gain
        unsure = self.doubt * np.maximum(params[:, :1], 0) * [1.0, 0.0]
        power = np.rint(np.asarray(horizons) / 0.1)[:, None]

        def states(error):
            return s[:, None] * (OPEN + self.shift + error - params)[:, None] ** power

        samples = None
        if n_samples:
            errors = np.resize(self.members, n_samples)
            samples = np.stack([states(error * unsure) for error in errors])
        n, steps = len(s), len(horizons)
        return Forecast(
            states(0.0 * unsure),
            times=np.tile(horizons, (n, 1)),
            horizons=np.asarray(horizons),
            lengths=np.full(n, steps),
            initial_states=s,
            initial_times=np.zeros(n),
            start=np.zeros(n, dtype=int),
            diverged_at=np.zeros(n, dtype=int),
            state_range=np.array([[-9.0, -9.0], [9.0, 9.0]]),
            state_names=("s0", "s1"),
            samples=samples,
        )


def search_of(model=None, **settings):
    return PolicySearch(
        Believed() if model is None else model,
        **{
            "bounds": BOUNDS,
            "reward": cost,
            "horizon": HORIZON,
            "n_evaluations": 300,
            "random_state": 0,
        }
        | settings,
    )


def proposed(model=None, trials=([0.3, 0.3],), **settings):
    """What is proposed after some trials."""
    search = search_of(model, **settings)
    for gains in trials:
        search.tell(fly(gains))
    return search.ask()


def told(search, n):
    for _ in range(n):
        search.tell(fly(search.ask()))
    return search


# -- it finds what there is to find -------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["cma", "cem", "random"])
def test_the_best_gains_are_found_in_the_third_trial(optimizer):
    search = told(search_of(linear(), n_initial=2, optimizer=optimizer), 3)
    atol = 0.2 if optimizer == "random" else 1e-2
    assert_allclose(search.best_params_, OPEN, atol=atol)
    assert search.best_reward_ == search.returns_[2]
    # the model is right, so the trial goes as predicted
    last = search.history().iloc[-1]
    assert_allclose(last["predicted"], last["return"], atol=1e-6)
    assert last["source"] == "model"


def test_the_gradient_finds_them_too():
    pytest.importorskip("trajlearn.control._gradient")
    model = TrajectoryRegressor(
        MLPEnsembleRegressor(hidden_layer_sizes=(32, 32), n_members=2, max_steps=600),
        random_state=0,
    )
    rng = np.random.default_rng(0)
    logged = [fly(gains) for gains in rng.uniform(*np.transpose(BOUNDS), size=(40, 2))]
    search = search_of(model, optimizer="gradient", n_evaluations=2000).tell(logged)
    gains = search.ask()
    predicted = search.predict_return([gains, *rng.uniform(*np.transpose(BOUNDS), size=(50, 2))])
    assert predicted.reward.argmax() == 0
    search.tell(fly(gains))
    assert search.best_reward_ == search.returns_[-1]
    # a constraint has no gradient: the search goes on without one
    search.set_params(constraint=lambda states: states[..., 0] > 0.0, n_samples=4)
    safe = search.ask()
    assert search.predict_return(safe).violation[0] <= 0.25
    assert safe[0] < gains[0]


def test_a_direct_reward_model_learns_the_returns():
    search = search_of(DirectRewardGP(random_state=0), n_initial=6)
    told(search, 6)
    trials = search.trials_
    model = search.set_params(n_initial=6).predict_return(trials.params)
    assert_allclose(model.reward, search.returns_, rtol=0.1, atol=0.3)
    assert (model.std > 0).all()
    told(search, 4)
    assert search.best_reward_ == search.returns_[6:].max() > search.returns_[:6].max()
    # rewards as logged, or as given by hand
    by_log = told(search_of(DirectRewardGP(random_state=0), n_initial=3, reward=None), 4)
    assert_array_equal(
        by_log.trials_.params,
        told(search_of(DirectRewardGP(random_state=0), n_initial=3), 4).trials_.params,
    )


def test_a_direct_reward_model_leaves_out_trials_without_a_return():
    trial = fly([0.3, 0.3])
    theta = np.linspace(0, 1, HORIZON)[:, None] * [1.0, 0.5]
    changing = Trajectory(
        trial.states, actions=trial.actions, rewards=trial.rewards, params=theta, dt=0.1
    )
    search = search_of(DirectRewardGP(random_state=0)).tell(changing)
    assert_array_equal(search.ask(), search_of().ask())
    search.tell([fly([0.3, 0.3]), fly([0.6, 0.4])])
    assert np.isfinite(search.ask()).all()
    assert search.history()["source"].tolist() == ["logged"] * 3
    # for a model of the dynamics it is data like any other
    assert not np.array_equal(search_of().tell(changing).ask(), search_of().ask())


def test_pipelines_plug_in():
    class Same(BaseEstimator):
        def fit(self, X, y=None):
            return self

        def transform(self, X):
            return X

    search = told(search_of(make_pipeline(Same(), linear()), n_initial=2), 3)
    assert_allclose(search.best_params_, OPEN, atol=1e-2)


# -- each parameter matters ---------------------------------------------------------------------


def test_bounds():
    assert_allclose(proposed(bounds=[[0.0, 0.8], [-0.5, 1.5]]), [0.8, 0.5], atol=1e-2)


def test_reward():
    def elsewhere(states):
        return -((states - [0.5, -0.5]) ** 2).sum(axis=-1)

    assert proposed(reward=elsewhere)[0] < 0.9
    assert_allclose(proposed(), OPEN, atol=1e-2)


def test_horizon():
    def far(states):
        # x is to stay where it is, and soon after to be gone
        return -np.abs(states[..., 0] - 0.5)

    short, long = (proposed(reward=far, horizon=h)[0] for h in (1, 6))
    assert_allclose(short, 0.5, atol=1e-2)
    assert long < 0.4


def test_n_initial():
    search = told(search_of(n_initial=3), 4)
    assert search.history()["source"].tolist() == ["sobol"] * 3 + ["model"]
    plain = told(RandomSearch(bounds=BOUNDS, reward=cost, horizon=HORIZON, random_state=0), 3)
    assert_array_equal(search.trials_.params[:3], plain.trials_.params)


def test_initial_states():
    def to_the_right(states):
        return -np.abs(states[..., 0] - 1.0)

    model = Believed()
    search = search_of(model, initial_states=[[0.5, 0.0]], reward=to_the_right)
    search.tell(fly([0.3, 0.3]))
    # from 0.5 only growing states come near 1
    assert search.ask()[0] < 0.15
    assert_allclose(np.unique(search.model_.starts_, axis=0), [[0.5, 0.0]])
    both = search_of(model).tell([fly([0.3, 0.3], (1.0, 0.0)), fly([0.3, 0.3], (0.0, 1.0))])
    both.ask()
    assert_allclose(np.unique(both.model_.starts_, axis=0), [[0.0, 1.0], [1.0, 0.0]])


def test_trials_that_begin_alike_are_predicted_once():
    search = search_of().tell([fly([0.3, 0.3]), fly([0.6, 0.6])])
    search.predict_return([[0.5, 0.5]])
    assert len(search.model_.starts_) == 1


def best_of(kappa, members, doubt):
    """Greatest mean - kappa * std of the members' returns, over a fine grid of gains of x."""
    gains = np.linspace(0, 2, 2001)
    powers = np.arange(1, HORIZON + 1)[:, None]
    returns = np.stack(
        [-(((1 - gains + error * doubt * gains) ** powers) ** 2).sum(axis=0) for error in members]
    )
    return gains[np.argmax(returns.mean(axis=0) - kappa * returns.std(axis=0))]


def test_objective_and_kappa():
    model = Believed(doubt=0.3, members=(0.0, 1.0, 2.0))
    assert_allclose(proposed(model, objective="mean")[0], 1.0, atol=1e-2)
    ends = []
    for kappa in (0.0, 0.3, 3.0):
        ends.append(best_of(kappa, model.members, model.doubt))
        found = proposed(model, objective="lcb", kappa=kappa, n_evaluations=600)
        assert_allclose(found[0], ends[-1], atol=2e-2)
    assert min(np.diff([1.0, *ends])) > 0.005
    # the mean of all returns, whatever kappa
    for optimizer in ("cma", "random"):
        settings = {"optimizer": optimizer, "n_evaluations": 100}
        assert_array_equal(
            proposed(model, objective="expected", kappa=2.0, **settings),
            proposed(model, objective="lcb", kappa=0.0, **settings),
        )
    with pytest.raises(NoUncertaintyError):
        proposed(linear(), objective="lcb")


def test_n_samples():
    one_sided = Believed(doubt=0.3, members=(0.0, 0.0, 0.0, 3.0))
    few, many = (proposed(one_sided, objective="lcb", n_samples=n)[0] for n in (3, 4))
    assert_allclose(few, 1.0, atol=1e-2)
    assert_allclose(many, best_of(1.0, one_sided.members, 0.3), atol=2e-2)
    assert abs(many - few) > 0.1


def test_thompson_draws_a_member_of_the_ensemble():
    ensemble = TrajectoryRegressor(
        MLPEnsembleRegressor(hidden_layer_sizes=(4,), n_members=3, max_steps=10), random_state=0
    )
    settings = {"objective": "thompson", "optimizer": "random", "n_evaluations": 64}
    found = {tuple(proposed(ensemble, random_state=seed, **settings)) for seed in range(6)}
    assert len(found) > 1
    search = search_of(ensemble, **settings).tell(fly([0.3, 0.3]))
    gains = search.ask()
    # told is what all members predict, as in any search
    search.tell(fly(gains))
    twin = search_of(ensemble).tell(fly([0.3, 0.3]))
    assert_allclose(search.history()["predicted"][1], twin.predict_return(gains).reward)
    with pytest.raises(ValueError, match="member of an ensemble"):
        proposed(linear(), objective="thompson")


def test_the_member_is_the_one_that_judges(monkeypatch):
    from trajlearn.control import policy_search as module

    monkeypatch.setattr(module, "n_members", lambda model: 2)
    members = [Believed(shift=shift).fit(None) for shift in (0.4, -0.3)]
    monkeypatch.setattr(module, "member_of", lambda model, i: members[i])
    settings = {"objective": "thompson", "n_evaluations": 600}
    found = [proposed(random_state=seed, **settings) for seed in range(8)]
    ends = {round(float(gains[0]), 1) for gains in found}
    assert ends == {0.7, 1.4}


def test_is_terminal_and_terminal_reward():
    def high(states):
        return states[..., 0] ** 2

    def beyond(states):
        return states[..., 0] > 1.2

    # leaving is what pays, unless that is the end of the trial
    free = proposed(reward=high, bounds=[[-0.3, 0.5], [0.4, 0.6]])
    ends = proposed(
        reward=high, bounds=[[-0.3, 0.5], [0.4, 0.6]], is_terminal=beyond, terminal_reward=0.0
    )
    paid = proposed(
        reward=high, bounds=[[-0.3, 0.5], [0.4, 0.6]], is_terminal=beyond, terminal_reward=50.0
    )
    assert_allclose(free[0], -0.3, atol=1e-2)
    assert ends[0] > -0.05
    assert paid[0] < -0.2


def test_a_predicted_crash_costs_the_least_reward_seen():
    low = fly([0.0, 0.5])
    search = search_of(is_terminal=lambda states: states[..., 0] < 0.9).tell(low)
    least = cost(low.states[1:]).min()
    # ends at the first step, where it earns 0
    assert_allclose(search.predict_return([OPEN]).reward, least * (HORIZON - 1), rtol=1e-6)
    search.set_params(terminal_reward=-7.0)
    assert_allclose(search.predict_return([OPEN]).reward, -7.0 * (HORIZON - 1), rtol=1e-6)
    by_hand = search_of(is_terminal=fallen).tell(low, reward=-3.0)
    with pytest.raises(ValueError, match="give terminal_reward="):
        by_hand.ask()


def positive(states):
    return states[..., 0] > 0.05


def test_constraint():
    model = Believed(doubt=0.02)
    free, safe = proposed(model), proposed(model, constraint=positive)
    assert_allclose(free[0], 1.0, atol=1e-2)
    # x_6 = (1 - k)^6 > 0.05 says k < 0.39
    assert 0.3 < safe[0] < 0.395
    assert_allclose(safe[1], 0.5, atol=0.1)
    for optimizer in ("cem", "random"):
        assert proposed(model, constraint=positive, optimizer=optimizer)[0] < 0.395


def test_max_violation():
    model = Believed(doubt=0.3, members=(-1.0, -1.0, -1.0, 1.0))
    settings = {"constraint": positive, "n_samples": 4}
    none, some = (proposed(model, max_violation=v, **settings)[0] for v in (0.2, 0.8))
    assert some > none + 0.05
    # shares below the limit are no reason to stay away
    assert_allclose(proposed(model, max_violation=1.0, **settings)[0], 1.0, atol=1e-2)


def test_nothing_safe_is_said_and_changes_nothing(tmp_path):
    search = search_of(constraint=lambda states: states[..., 0] > 0.9, bounds=[[0.3, 2], [0, 1]])
    search.tell(fly([0.3, 0.3]))
    before = contents(search, tmp_path)
    with pytest.raises(UnsafeProposalError, match=r"found is 1, above max_violation = 0.05"):
        search.ask()
    assert same_contents(contents(search, tmp_path), before)
    # the user decides
    assert_allclose(search.set_params(max_violation=1.0).ask()[0], 1.0, atol=1e-2)


def test_from_where_all_violates_the_search_goes_to_where_less_does():
    # a share of members fails, the fewer the smaller the gain of x
    model = Believed(doubt=1.0, members=np.linspace(-1.0, 1.0, 20))
    search = search_of(
        model,
        constraint=lambda states: states[..., 0] > 0.0,
        n_samples=20,
        n_evaluations=600,
        bounds=[[0.0, 40.0], [0.4, 0.6]],
        max_violation=0.0,
    ).tell(fly([0.3, 0.3]))
    assert search.predict_return(search.ask()).violation[0] == 0.0


def test_every():
    search = search_of(every=3).tell(fly([0.3, 0.3]))
    rough = search.predict_return([[0.3, 0.3]])
    assert search.model_.steps_ == 2
    fine = search_of().tell(fly([0.3, 0.3])).predict_return([[0.3, 0.3]])
    assert rough.reward[0] != fine.reward[0]


def test_n_evaluations():
    few, many = (
        np.abs(proposed(optimizer="random", n_evaluations=n) - OPEN).max() for n in (4, 3000)
    )
    assert many < 0.1 < few


def test_policy_is_that_of_the_model_and_of_the_trials():
    def halved(states, params, times):
        return -0.5 * params * states

    search = search_of(
        OneStepRegressor(LinearRegression()),
        policy=halved,
        n_initial=2,
        bounds=[[0.0, 4.0], [-1.0, 3.0]],
    )
    env = Plant()
    search.run(env, 1)
    assert env.flown[0][3] is halved
    for gains in ([0.3, 0.3], [0.6, 0.8]):
        search.tell(fly(gains))
    assert_allclose(search.ask(), 2 * OPEN, atol=2e-2)


def test_random_state():
    found = {tuple(search_of(random_state=seed).ask()) for seed in (0, 0, 1)}
    assert len(found) == 2
    a, b, c = (proposed(optimizer="random", random_state=seed) for seed in (0, 0, 1))
    assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    # the model's seed is the search's, unless it has its own
    search = told(search_of(), 1)
    search.ask()
    assert isinstance(search.model_.seed_, int)
    own = told(search_of(Believed(random_state=5)), 1)
    own.ask()
    assert own.model_.seed_ == 5


# -- the model ----------------------------------------------------------------------------------


def test_the_model_is_cloned_and_fitted_on_all_trials():
    model = Believed()
    search = told(search_of(model), 3)
    search.ask()
    assert not hasattr(model, "fitted_on_")
    assert search.model_.fitted_on_ == search.trials_
    before = search.model_
    search.predict_return([[0.5, 0.5]])
    assert search.model_ is before
    search.tell(fly([0.1, 0.1]))
    search.predict_return([[0.5, 0.5]])
    assert len(search.model_.fitted_on_) == 4


def test_the_model_is_there_at_once_after_resuming(tmp_path):
    search = told(search_of(linear(), n_initial=2), 3)
    search.ask()
    search.save(tmp_path / "search.npz")
    resumed = search_of(linear(), n_initial=2)
    assert not hasattr(resumed, "model_")
    resumed.resume(tmp_path / "search.npz")
    assert_array_equal(
        resumed.model_.predict(search.trials_).mean, search.model_.predict(search.trials_).mean
    )
    # until something new is asked, it is the model of what was asked
    before = resumed.model_
    resumed.tell(fly([0.2, 0.2]))
    assert resumed.model_ is before
    # a file of other trials has another model
    other = told(search_of(linear(), n_initial=2), 1)
    other.save(tmp_path / "other.npz")
    resumed.resume(tmp_path / "other.npz")
    assert resumed.model_ is not before
    assert not hasattr(search_of(linear(), random_state=1).resume(nothing(tmp_path)), "model_")
    frozen = FrozenEstimator(linear().fit(search.trials_))
    assert search_of(frozen, n_initial=0).model_ is frozen.estimator


def nothing(folder):
    """A file of a search that was told nothing."""
    search_of(random_state=1).save(folder / "nothing.npz")
    return folder / "nothing.npz"


def test_a_frozen_model_is_taken_as_it_is():
    logged = TrajectoryDataset([fly([0.3, 0.3]), fly([1.5, 1.2])])
    model = linear().fit(logged)
    search = search_of(
        FrozenEstimator(model), n_initial=0, initial_states=START, terminal_reward=-1.0
    )
    assert_allclose(search.ask(), OPEN, atol=1e-2)
    assert search.model_ is model
    told(search, 2)
    assert search.history()["source"].tolist() == ["model", "model"]
    with pytest.raises(ValueError, match="initial_states="):
        search_of(FrozenEstimator(model), n_initial=0).ask()
    # one that is yet to learn begins with a point of the sequence
    assert_array_equal(search_of(n_initial=0).ask(), search_of().ask())


def test_predict_return():
    search = search_of(Believed(doubt=0.2), constraint=positive, objective="lcb", kappa=2.0)
    with pytest.raises(ValueError, match="no trial was told"):
        search.predict_return([[0.5, 0.5]])
    search.tell(fly([0.3, 0.3]))
    found = search.predict_return([[0.3, 0.3], [0.9, 0.4]])
    assert_allclose(found.value, found.reward - 2.0 * found.std)
    assert found.violation[0] < found.violation[1]
    exact = search_of().tell(fly([0.3, 0.3])).predict_return([0.3, 0.3])
    assert_allclose(exact.reward, search.returns_)
    assert exact.std.tolist() == [0.0]
    assert exact.violation is None
    unsure = search_of(linear()).tell(fly([0.3, 0.3])).predict_return([[0.3, 0.3]])
    assert unsure.std is None
    for wrong, message in [([[0.3]], "expected"), ([[0.3, np.nan]], "NaN")]:
        with pytest.raises(ValueError, match=message):
            search.predict_return(wrong)


def test_std_is_about_the_expected_return_whatever_is_maximised():
    model = Believed(doubt=0.3, members=(0.0, 1.0, 2.0))
    found = {
        objective: search_of(model, objective=objective, n_samples=3)
        .tell(fly([0.3, 0.3]))
        .predict_return([[0.3, 0.3], [0.9, 0.4]])
        for objective in ("mean", "expected")
    }
    mean, expected = found["mean"], found["expected"]
    assert (mean.reward - mean.expected > 0.05).all()
    assert_array_equal(mean.value, mean.reward)
    assert_allclose(mean.expected, expected.reward)
    assert_allclose(mean.std, expected.std)
    assert_array_equal(expected.expected, expected.reward)
    assert search_of(linear()).tell(fly([0.3, 0.3])).predict_return([0.3, 0.3]).expected is None
    # and so in the table
    search = search_of(model, n_samples=3).tell(fly([0.3, 0.3]))
    row = search.tell(fly(search.ask())).history().iloc[-1]
    # samples of one seed: the same three members
    assert_allclose(
        row["expected"], search.predict_return(search.trials_.params[1]).expected, rtol=1e-6
    )
    assert row["predicted"] > row["expected"]


def test_start_points_are_the_best_trial_and_the_last_proposal(tmp_path):
    # one evaluation more than the two start points: the better of them is found
    search = search_of(optimizer="random", n_evaluations=2)
    search.tell([fly(OPEN), fly([0.3, 0.3])])
    assert_array_equal(search.ask(), OPEN)
    # best of the trials that were worse than the proposal: the proposal stays
    search = search_of(optimizer="random", n_evaluations=2).tell(fly([5.0, 0.5], (0.1, 0.1)))
    last = search.ask()
    search.tell(fly([0.3, 0.3]))
    assert_array_equal(search.ask(), last if cost(last - OPEN) > cost(OPEN - 0.3) else [0.3, 0.3])
    # a file remembers it, too
    search = search_of(optimizer="random", n_evaluations=2, random_state=3)
    search.tell(fly(search.ask() + 3.0))
    last = search_of(random_state=3).ask()
    search.save(tmp_path / "search.npz")
    again = search_of(optimizer="random", n_evaluations=2).resume(tmp_path / "search.npz")
    assert_array_equal(again.ask(), search.ask())
    assert_array_equal(again.ask(), last)


def test_references_and_context_of_the_next_trial_are_those_of_the_last():
    class Tracking(Believed):
        def predict_trajectory(self, *args, references, context, phase, **kwargs):
            self.told_ = references(np.array([0.0, 0.1])), context, phase
            return super().predict_trajectory(*args, **kwargs)

    def flown(level, **more):
        trial = fly([0.3, 0.3])
        return Trajectory(
            trial.states,
            actions=trial.actions,
            params=trial.params,
            dt=0.1,
            context={"load": 2},
            references=np.full((HORIZON + 1, 1), level),
            time_origin=-0.5,
            **more,
        )

    search = search_of(Tracking()).tell([flown(1.0), flown(3.0)])
    search.ask()
    references, context, phase = search.model_.told_
    assert_allclose(references, [[3.0], [3.0]])
    assert context == {"load": 2}
    assert_allclose(phase, 0.5)


def at_time(trial, start, **more):
    return Trajectory(
        trial.states,
        actions=trial.actions,
        params=trial.params,
        times=start + 0.1 * np.arange(len(trial.states)),
        terminated=trial.terminated,
        **more,
    )


def test_clocks_of_trials_are_those_of_predictions():
    search = search_of(linear(), reward=lambda states, times: states[..., 0] * times, n_initial=2)
    search.tell([at_time(fly(gains), 50.0) for gains in ([0.3, 0.3], [0.6, 0.4])])
    predicted = search.predict_return([[0.3, 0.3], [0.6, 0.4]])
    assert_allclose(predicted.reward, search.returns_)


def test_without_the_references_of_a_whole_trial_sobol_points_go_on():
    def tracking(gains):
        trial = fly(gains)
        return at_time(trial, 0.0, references=np.zeros((len(trial.states), 1)))

    class Tracking(Believed):
        def predict_trajectory(self, *args, references, **kwargs):
            return super().predict_trajectory(*args, **kwargs)

    search = search_of(Tracking()).tell(tracking([5.0, 0.5]))
    assert search.trials_.lengths[0] < HORIZON
    with pytest.raises(ValueError, match="references of the next one are unknown"):
        search.predict_return([[0.3, 0.3]])
    gains = search.ask()
    assert_array_equal(gains, search_of().ask())
    search.tell(tracking(gains)).ask()
    assert search.tell(tracking(search.ask())).history()["source"].tolist() == [
        "logged",
        "sobol",
        "model",
    ]


def test_what_holds_of_all_forecasts_is_said_once():
    model = TrajectoryRegressor(random_state=0).set_params(
        estimator__max_steps=3, estimator__n_members=2
    )
    search = search_of(model, n_evaluations=70).tell(fly([5.0, 0.5]))
    for call in (search.ask, lambda: search.predict_return([[0.3, 0.3], [0.5, 0.5]])):
        with pytest.warns(HorizonWarning) as said:
            call()
        assert [each.category for each in said] == [HorizonWarning]


# -- errors leave the search as it was ------------------------------------------------------------


class Failing(Believed):
    def fit(self, X, y=None):
        if len(X) >= 3:
            raise FloatingPointError("the fit broke down")
        return super().fit(X)


def test_a_failing_fit_comes_through_and_changes_nothing(tmp_path):
    search = told(search_of(Failing()), 3)
    before = contents(search, tmp_path)
    with pytest.raises(FloatingPointError, match="broke down") as caught:
        search.ask()
    assert "3 trial(s) told" in caught.value.__notes__[0]
    assert same_contents(contents(search, tmp_path), before)
    env = Plant()
    with pytest.raises(FloatingPointError) as caught:
        search.run(env, 2)
    assert "trial 3" in caught.value.__notes__[1]
    assert not env.flown
    assert same_contents(contents(search, tmp_path), before)
    # another model takes over
    assert_allclose(search.set_params(model=Believed()).ask(), OPEN, atol=1e-2)


def test_a_reward_that_is_nan_for_predicted_states_changes_nothing(tmp_path):
    def nan_near_zero(states):
        return np.where((np.abs(states) < 0.1).all(axis=-1), np.nan, cost(states))

    search = search_of(reward=nan_near_zero).tell(fly([0.0, 0.0], length=HORIZON))
    before = contents(search, tmp_path)
    with pytest.raises(ValueError, match="returned NaN"):
        search.ask()
    assert same_contents(contents(search, tmp_path), before)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"optimizer": "adam"}, "optimizer"),
        ({"objective": "ucb"}, "objective"),
        ({"n_initial": -1}, "n_initial"),
        ({"kappa": -1.0}, "kappa"),
        ({"n_samples": 0}, "n_samples"),
        ({"every": 0}, "every"),
        ({"n_evaluations": 0}, "n_evaluations"),
        ({"max_violation": 1.5}, "max_violation"),
        ({"constraint": 3}, "constraint"),
        ({"is_terminal": "fallen"}, "is_terminal"),
        ({"policy": 1.0}, "policy"),
        ({"bounds": [[1.0, 0.0], [0.0, 1.0]]}, "lower bound"),
        ({"horizon": 0}, "horizon"),
    ],
    ids=str,
)
def test_impossible_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        search_of(**settings).ask()


def test_what_cannot_go_together_is_named():
    with pytest.raises(ValueError, match="direct reward models"):
        proposed(reward=None, trials=()) is not None and search_of(reward=None).tell(
            fly([0.3, 0.3])
        ).ask()
    with pytest.raises(ValueError, match="2 states a step, initial_states= has 3"):
        search_of(initial_states=[1.0, 2.0, 3.0]).tell(fly([0.3, 0.3]))
    with pytest.raises(ValueError, match="knows no constraint="):
        proposed(DirectRewardGP(random_state=0), [[0.3, 0.3], [0.6, 0.6]], constraint=positive)
    with pytest.raises(ValueError, match="model"):
        search_of(object()).ask()
    for call in (lambda s: s.ask(), lambda s: s.tell(fly([0.3, 0.3]))):
        message = r"model = OneStepRegressor is a class: give an estimator, model = OneStepReg"
        with pytest.raises(ValueError, match=message):
            call(search_of(OneStepRegressor))
    # before a trial is run
    for objective in ("expected", "lcb"):
        with pytest.raises(ValueError, match=f"cannot follow objective='{objective}'"):
            search_of(optimizer="gradient", objective=objective).ask()
    with pytest.raises(NotFittedError):
        search_of(FrozenEstimator(linear()), n_initial=0, initial_states=[1.0, 1.0]).ask()


def test_a_clone_starts_anew():
    search = told(search_of(), 2)
    again = clone(search)
    assert not hasattr(again, "returns_")
    assert_array_equal(told(again, 2).trials_.params, search.trials_.params)


# -- simulators and files -------------------------------------------------------------------------


def test_crashes_in_a_simulator_are_data():
    env = Cartpole(gains="unstable")
    search = PolicySearch(
        OneStepRegressor(LinearRegression(), policy=env.policy),
        bounds=env.param_bounds,
        reward=env.reward,
        horizon=30,
        is_terminal=env.is_terminal,
        n_initial=4,
        n_evaluations=200,
        random_state=0,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        search.run(env, 6, initial_states=[0.0, 0.0, 0.1, 0.0])
    table = search.history()
    assert table["terminated"].any()
    # each trial that crashed is worse than any that did not
    crashed = table["terminated"]
    assert table["return"][crashed].max() < table["return"][~crashed].min()
    assert table["source"].tolist() == ["sobol"] * 4 + ["model"] * 2
    assert table["return"][4:].max() > table["return"][:4].max()


def test_a_process_killed_between_ask_and_tell_goes_on_as_if_never_stopped(tmp_path):
    killed_after_ask(lambda: tuned_by_a_model(random_state=0), tmp_path / "search.npz")
    resumed = tuned_by_a_model(random_state=None).resume(tmp_path / "search.npz")
    never_stopped = told(tuned_by_a_model(random_state=0), 2)
    # the proposal that waits is a model's
    assert not np.array_equal(never_stopped.ask(), search_of(n_initial=3).ask())
    for _ in range(2):
        gains = resumed.ask()
        assert_array_equal(gains, never_stopped.ask())
        # not where the model wants it, so that the next proposal is another
        resumed.tell(fly(gains + 0.1))
        never_stopped.tell(fly(gains + 0.1))
    assert resumed.history().equals(never_stopped.history())


def test_predicted_trials_that_never_end_are_warned_of():
    with pytest.warns(UserWarning, match=r"1 trial\(s\) ended early, but is_terminal=None"):
        search_of().tell([fly([5.0, 0.5]), fly(OPEN)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        search_of(is_terminal=fallen, terminal_reward=-9.0).tell(fly([5.0, 0.5]))
        search_of().tell(fly(OPEN))


def test_a_reward_that_only_knows_one_trial_is_refused_before_it_is_told():
    search = search_of(reward=lambda states: -(states[:, 0] ** 2))
    with pytest.raises(ValueError, match="one number a state"):
        search.tell(fly(OPEN))
    with pytest.raises(AttributeError, match="no trial was told"):
        _ = search.trials_
