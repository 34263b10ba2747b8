"""Policies that several members learn from the same log: once, and the same as each by itself."""

import numpy as np
import pytest
from joblib import parallel_config
from sklearn.linear_model import LinearRegression

from tests.dynamics.systems import linear
from trajlearn import (
    HorizonSelector,
    MLPEnsembleRegressor,
    OneStepRegressor,
    TrajectoryRegressor,
    TransitionRelabeler,
)
from trajlearn.dynamics._rollouts import rolling
from trajlearn.dynamics._rollouts.cloned_policy import clone_policy
from trajlearn.dynamics._selection import shared_policies
from trajlearn.dynamics._selection.shared_policies import SharedPolicies
from trajlearn.regressors import polynomial

FOLDS = [(np.arange(4, 8), np.arange(4)), (np.arange(4), np.arange(4, 8))]


def one_step(degree=1, **settings):
    learner = polynomial(degree)
    return OneStepRegressor(
        learner, **{"policy": "clone", "policy_estimator": LinearRegression(), **settings}
    )


@pytest.fixture
def learned(monkeypatch):
    """How many episodes each policy was learned from: shared ones, and others."""
    calls = {"shared": [], "own": []}

    def counted(kind):
        def learn(ds, *args, **settings):
            calls[kind].append(len(ds))
            return clone_policy(ds, *args, **settings)

        return learn

    monkeypatch.setattr(shared_policies, "clone_policy", counted("shared"))
    monkeypatch.setattr(rolling, "clone_policy", counted("own"))
    return calls


def fitted(ds, *members, **settings):
    names = [f"m{i}" for i in range(len(members))]
    settings = {"race": False, "random_state": 0, "cv": FOLDS, **settings}
    return HorizonSelector(list(zip(names, members)), **settings).fit(ds)


def test_each_policy_is_learned_once(learned):
    ds = linear(8)
    model = fitted(ds, one_step(1), one_step(2), one_step(3))
    assert learned == {"shared": [4, 4, 8], "own": []}
    for member in model.estimators_:
        assert member.policy == "clone"
        assert member.policy_ is model.estimators_[0].policy_
        assert member.predict(ds).actions == "policy"


def test_members_that_are_fitted_on_some_rows_learn_the_policy_from_all(learned):
    ds = linear(8)
    some = one_step(2, relabeler=TransitionRelabeler(max_rows=20))
    model = fitted(ds, one_step(1), some)
    assert learned == {"shared": [4, 4, 8], "own": []}
    assert model.estimators_[1].policy_ is model.estimators_[0].policy_


def test_forecasts_are_those_of_members_that_learn_their_own():
    ds = linear(8)
    network = MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=30, batch_size=16)
    members = one_step(1), one_step(2), one_step().set_params(estimator=network)
    together = fitted(ds, *members)
    for i, member in enumerate(members):
        member.set_params(random_state=0)
        (alone,) = fitted(ds, member).estimators_
        np.testing.assert_array_equal(
            alone.policy_.estimator.coef_, together.estimators_[i].policy_.estimator.coef_
        )
        if i < 2:
            np.testing.assert_array_equal(
                together.estimators_[i].predict(ds).mean, alone.predict(ds).mean
            )
            one = together.cv_errors_.set_index("member").loc[f"m{i}", "median"]
            own = fitted(ds, member).cv_errors_["median"]
            np.testing.assert_allclose(one.to_numpy(), own.to_numpy())


def test_members_with_other_settings_have_policies_of_their_own(learned):
    ds = linear(8)
    shared = one_step(1), one_step(2)
    other = (
        one_step(policy_estimator=polynomial(2)),
        one_step(history=2),
        one_step(baseline="mean", inputs=("action", "references")),
        one_step(inputs=("action", "dt")),
        TrajectoryRegressor(LinearRegression()),
    )
    fitted(ds, *shared, *other)
    assert learned["shared"] == [4, 4, 8]
    assert sorted(learned["own"]) == [4] * 8 + [8] * 4


def test_pairs_of_settings_are_told_apart():
    members = [(str(i), one_step(history=h)) for i, h in enumerate((1, 2, 1, 2))]
    shared = SharedPolicies(members, linear(8), FOLDS, np.random.default_rng(0), None)
    shared.learn(["0", "1"], [0])
    assert shared.of("0") is shared.of("2")
    assert shared.of("0") is not shared.of("1")
    assert [shared.of(name)[0].history for name in ("0", "1")] == [1, 2]
    assert shared.seconds("3") > 0


def test_smoothed_members_learn_from_their_own_states(learned):
    ds = linear(8, shortest=150, longest=150).add_noise(0.3, random_state=0)
    model = fitted(ds, one_step(1), one_step(1, random_state=0), one_step(1, denoise="em"))
    assert model.estimators_[2].noisy_
    assert learned["shared"] == [4, 4, 8]
    assert sorted(learned["own"]) == [4, 4, 8]
    coefs = [member.policy_.estimator.coef_ for member in model.estimators_]
    assert np.abs(coefs[0] - coefs[2]).max() > 1e-3


def test_only_what_the_race_needs_is_learned(learned):
    ds = linear(8)
    members = [(name, one_step(k)) for k, name in enumerate("abc", start=1)]
    shared = SharedPolicies(members, ds, FOLDS, np.random.default_rng(0), None)
    shared.learn(["a", "b", "c"], [0])
    shared.learn(["c"], [0, 2])
    assert learned["shared"] == [4, 8]
    assert sorted(shared.of("a")) == [0, 2]
    assert shared.of("none") == {}


def test_its_cost_is_that_of_each_member(monkeypatch):
    learned = shared_policies._learned
    monkeypatch.setattr(shared_policies, "_learned", lambda *given: (learned(*given)[0], 1000.0))
    members = one_step(1), one_step(2), TrajectoryRegressor(LinearRegression())
    slow = fitted(linear(8), *members).fit_seconds_
    # two folds and all episodes; who shares none does not pay
    assert slow["m0"] > 3000
    assert slow["m1"] > 3000
    assert slow["m2"] < 1000


def test_an_error_says_that_it_is_the_shared_policy():
    class Fails(LinearRegression):
        def fit(self, X, y, sample_weight=None):
            raise ValueError("no")

    members = [one_step(k, policy_estimator=Fails()) for k in (1, 2)]
    with pytest.raises(ValueError, match="no") as caught:
        fitted(linear(8), *members)
    assert "policy that members of a HorizonSelector share" in caught.value.__notes__[0]


def test_the_number_of_workers_changes_nothing():
    ds = linear(8)
    members = one_step(1), one_step(2)
    alone = fitted(ds, *members)
    with parallel_config("threading"):
        together = fitted(ds, *members, n_jobs=2)
    np.testing.assert_array_equal(alone.predict(ds).mean, together.predict(ds).mean)


def test_what_one_member_alone_is_refused_is_refused_of_several():
    network = MLPEnsembleRegressor(hidden_layer_sizes=(4,), max_steps=5, batch_size=8)
    member = OneStepRegressor(network, loss_horizon=2, history=2, policy="clone")
    with pytest.raises(ValueError, match="policy='clone' knows slopes") as alone:
        member.fit(linear(8))
    with pytest.raises(ValueError, match="policy='clone' knows slopes") as shared:
        fitted(linear(8), member, member)
    assert str(alone.value) == str(shared.value)
