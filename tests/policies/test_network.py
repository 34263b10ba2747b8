"""Networks as policies against plain loops, in batches and alone, and on bad input."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn import OneStepRegressor, TrajectoryDataset, load
from trajlearn.policies import NetworkPolicy


def by_hand(policy, state, weights):
    """One network at one state, layer by layer with plain loops."""
    sizes = [policy.n_states, *policy.hidden, policy.n_actions]
    weights, x = iter(weights.tolist()), state.tolist()
    for layer, outputs in enumerate(sizes[1:]):
        rows = [[next(weights) for _ in x] for _ in range(outputs)]
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + next(weights) for row in rows]
        if layer < len(sizes) - 2:
            x = [np.tanh(v) if policy.activation == "tanh" else max(v, 0.0) for v in x]
    assert next(weights, None) is None
    if policy.bounds is None:
        return x
    low, high = policy.bounds
    return [low + (high - low) * (np.tanh(v) + 1) / 2 for v in x]


NETWORKS = [
    NetworkPolicy(n_states=4, n_actions=1),
    NetworkPolicy((3, 6), n_states=2, n_actions=3, activation="relu", bounds=(-0.5, 2.0)),
    NetworkPolicy((), n_states=3, n_actions=2, bounds=None),
]


@pytest.mark.parametrize("policy", NETWORKS, ids=["default", "two layers", "no layer"])
@given(n=st.integers(1, 30), seed=st.integers(0, 2**32 - 1))
def test_every_row_is_a_network_of_its_own(policy, n, seed):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, policy.n_states))
    weights = rng.normal(size=(n, policy.n_params))
    together = policy(states, weights, np.zeros(n))
    want = [by_hand(policy, s, w) for s, w in zip(states, weights, strict=True)]
    np.testing.assert_allclose(together, want, rtol=1e-12, atol=1e-12)
    alone = [policy(states[i : i + 1], weights[i : i + 1], np.zeros(1)) for i in range(n)]
    np.testing.assert_array_equal(together, np.concatenate(alone))
    # columns or gaps in memory
    columns = policy(np.asfortranarray(states), np.asfortranarray(weights), np.zeros(n))
    np.testing.assert_array_equal(together, columns)
    gaps = policy(np.repeat(states, 2, 1)[:, ::2], np.repeat(weights, 2, 1)[:, ::2], np.zeros(n))
    np.testing.assert_array_equal(together, gaps)


@pytest.mark.parametrize("policy", NETWORKS, ids=["default", "two layers", "no layer"])
def test_responses_are_the_actions_at_the_probe_states(policy):
    rng = np.random.default_rng(0)
    probes = rng.normal(size=(5, policy.n_states))
    weights = rng.normal(size=(4, policy.n_params))
    got = policy.responses(weights, probes)
    assert got.shape == (4, 5 * policy.n_actions)
    want = [policy(probes, np.tile(row, (5, 1)), np.zeros(5)).ravel() for row in weights]
    np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-14)


def test_responses_do_not_see_the_order_of_hidden_units():
    policy = NetworkPolicy((3,), n_states=2, n_actions=1)
    weights = np.random.default_rng(0).normal(size=(1, policy.n_params))
    order = [2, 0, 1]
    inner, bias, outer = weights[0, :6].reshape(3, 2), weights[0, 6:9], weights[0, 9:12]
    swapped = np.concatenate([inner[order].ravel(), bias[order], outer[order], weights[0, 12:]])
    probes = np.random.default_rng(1).normal(size=(3, 2))
    assert not np.allclose(swapped, weights)
    np.testing.assert_allclose(
        policy.responses(swapped[None], probes), policy.responses(weights, probes)
    )


def test_number_of_weights_and_reach_of_the_actions():
    policy = NetworkPolicy((5,), n_states=4, n_actions=1, bounds=(-3, 1))
    assert policy.n_params == 4 * 5 + 5 + 5 + 1
    weights = 100 * np.random.default_rng(0).normal(size=(50, 31))
    actions = policy(np.ones((50, 4)), weights, np.zeros(50))
    assert actions.min() == pytest.approx(-3)
    assert actions.max() == pytest.approx(1)
    at_rest = policy(np.ones((1, 4)), np.zeros((1, 31)), np.zeros(1))
    assert at_rest[0, 0] == pytest.approx(-1)
    assert policy(np.empty((0, 4)), np.empty((0, 31)), np.empty(0)).shape == (0, 1)


def test_network_policy_is_an_immutable_picklable_value():
    policy = NetworkPolicy([4, 2], n_states=3, n_actions=1, bounds=[-2, 2])
    same = NetworkPolicy((4, 2), n_states=3, n_actions=1, bounds=(-2.0, 2.0))
    assert pickle.loads(pickle.dumps(policy)) == policy == same
    assert hash(policy) == hash(same)
    assert policy != NetworkPolicy((4, 2), n_states=3, n_actions=1)
    with pytest.raises(AttributeError):
        policy.hidden = (3,)


def test_a_model_is_saved_with_its_network_policy(tmp_path):
    policy = NetworkPolicy((3,), n_states=1, n_actions=1, bounds=None)
    weights = np.random.default_rng(0).normal(size=(2, policy.n_params))
    states = np.random.default_rng(1).normal(size=(2, 6, 1))
    ds = TrajectoryDataset.from_arrays(states, actions=states[:, 1:], params=weights)
    model = OneStepRegressor(policy=policy, random_state=0).set_params(estimator__max_steps=2)
    model.fit(ds).save(tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    assert again.policy == policy
    np.testing.assert_array_equal(again.predict(ds).mean, model.predict(ds).mean)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hidden": 5}, "hidden must be a tuple of layer sizes"),
        ({"hidden": (5, 0)}, "every size in hidden must be an integer of at least 1; got 0"),
        ({"n_states": 0}, "n_states must be an integer of at least 1"),
        ({"n_actions": 1.5}, "n_actions must be an integer of at least 1"),
        ({"activation": "sin"}, "activation must be 'tanh' or 'relu'; got 'sin'"),
        ({"bounds": (1.0, -1.0)}, "bounds must satisfy low < high"),
        ({"bounds": (0.0, np.inf)}, "bounds must be finite"),
    ],
)
def test_bad_settings_of_a_network_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        NetworkPolicy(**({"n_states": 4, "n_actions": 1} | arguments))


@pytest.mark.parametrize(
    ("states", "params", "times", "message"),
    [
        (np.zeros(4), np.zeros((1, 31)), np.zeros(1), r"states must have shape \(n, 4\)"),
        (np.zeros((2, 3)), np.zeros((2, 31)), np.zeros(2), r"states must have shape \(n, 4\)"),
        (np.zeros((2, 4)), np.zeros((2, 30)), np.zeros(2), "weights of a network 4-5-1; got"),
        (np.zeros((2, 4)), np.zeros((1, 31)), np.zeros(2), "one row for each of the 2 states"),
        (np.zeros((2, 4)), np.zeros((2, 31)), 0.0, "times must have shape"),
    ],
)
def test_wrong_shapes_for_a_network_are_named(states, params, times, message):
    policy = NetworkPolicy(n_states=4, n_actions=1)
    with pytest.raises(ValueError, match=message):
        policy(states, params, times)


def test_wrong_probe_states_are_named():
    policy = NetworkPolicy(n_states=4, n_actions=1)
    with pytest.raises(ValueError, match="probe_states must have shape"):
        policy.responses(np.zeros((1, 31)), np.zeros((2, 3)))
