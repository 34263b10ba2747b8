"""Models by name: what they see of a controller."""

import pickle

import numpy as np
import pytest
from sklearn.base import clone

from benchmarks.paper._models import QUICK_STEPS, build, controller_features
from benchmarks.paper._rollouts import action_sources
from benchmarks.paper._tasks import TASKS, environment
from trajlearn import PID, LinearFeedback, Reacher


def reached(n, joints=5, seed=0):
    """States and params of arms anywhere, and the angles behind them."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, (n, joints))
    states = np.hstack([np.cos(angle), np.sin(angle), rng.normal(size=(n, joints))])
    params = rng.uniform([0, 0, -1], 1, (joints, n, 3)).transpose(1, 2, 0).reshape(n, 3 * joints)
    return states, params, angle


@pytest.mark.parametrize("bounds", [(-1.0, 1.0), (-0.2, 0.3), None], ids=str)
@pytest.mark.parametrize("feedback", ["angle", "cos"])
def test_pid_features_are_the_numbers_of_the_policy(feedback, bounds):
    policy = PID(feedback, bounds=bounds, p_scale=4.0)
    states, params, angle = reached(200)
    error, proportional, equilibrium = np.hsplit(controller_features(policy)(states, params), 3)
    target = params[:, 10:]
    np.testing.assert_allclose(error, target - (angle if feedback == "angle" else np.cos(angle)))
    # at rest the derivative part is zero and the action the proportional part
    at_rest = np.hstack([states[:, :10], np.zeros((200, 5))])
    np.testing.assert_array_equal(proportional, policy(at_rest, params, np.ones(200)))
    # at the equilibrium there is nothing to correct
    cos = np.cos(target) if feedback == "angle" else target
    there = np.hstack([cos, equilibrium, np.zeros((200, 5))])
    np.testing.assert_allclose(policy(there, params, np.ones(200)), 0, atol=1e-12)
    np.testing.assert_allclose(cos**2 + equilibrium**2, 1)


@pytest.mark.parametrize("bounds", [(-1.0, 1.0), None], ids=str)
def test_feedback_features_are_the_action_applied_and_wanted(bounds):
    rng = np.random.default_rng(0)
    states, params = rng.normal(size=(50, 4)), rng.normal(size=(50, 8))
    policy = LinearFeedback(bounds)
    applied, wanted = np.hsplit(controller_features(policy)(states, params), 2)
    np.testing.assert_array_equal(applied, policy(states, params, np.zeros(50)))
    gains = params.reshape(50, 2, 4)
    np.testing.assert_allclose(wanted, -np.einsum("nij,nj->ni", gains, states))
    assert (np.abs(wanted) > 1).any()


def test_there_are_none_of_an_unknown_controller():
    with pytest.raises(ValueError, match="no features of a function"):
        controller_features(lambda states, params, times: states)


@pytest.mark.parametrize(
    "env", [*map(environment, TASKS), Reacher(controller="cos")], ids=[*TASKS, "reacher, cos"]
)
def test_t_with_features_fits_clones_and_travels(env):
    model = build("T, features", "default", policy=env.policy, mode="quick", seed=3)
    assert model.get_params()["estimator__max_steps"] == QUICK_STEPS
    assert action_sources("T, features") == ["none"]
    train = env.collect(4, 8, random_state=0)
    model.set_params(estimator__max_steps=10, estimator__hidden_layer_sizes=(8,)).fit(train)
    found = np.asarray(model.predict(train))
    elsewhere = pickle.loads(pickle.dumps(clone(model))).fit(train)
    np.testing.assert_array_equal(np.asarray(elsewhere.predict(train)), found)
    plain = clone(model).set_params(scaler__features=None).fit(train)
    assert not np.array_equal(np.asarray(plain.predict(train)), found)


def test_the_first_logged_action_is_among_the_features():
    env = environment("cartpole")
    ds = env.collect(5, 6, random_state=0)
    states, actions = (
        np.array([getattr(e, field)[0] for e in ds]) for field in ("states", "actions")
    )
    np.testing.assert_allclose(controller_features(env.policy)(states, ds.params)[:, :1], actions)
