"""A plant whose best gains are known, and a simulator of it with the doors of an Environment."""

import numpy as np
from sklearn.linear_model import LinearRegression

from trajlearn import OneStepRegressor, Trajectory, TrajectoryDataset
from trajlearn.control.policy_search import PolicySearch

# s' = (open - k) s, each coordinate alone: gains equal to `OPEN` bring it to rest in one step
OPEN = np.array([1.0, 0.5])
BOUNDS = [[0.0, 2.0], [-0.5, 1.5]]
HORIZON = 6
LIMIT = 5.0


def cost(states):
    return -(states**2).sum(axis=-1)


def policy(states, params, times):
    return -params * states


def fallen(states):
    return (np.abs(states) > LIMIT).any(axis=-1)


def fly(gains, start=(1.0, -1.0), length=HORIZON):
    """One trial; it ends where a state leaves the limit."""
    states, done = [np.asarray(start, dtype=float)], False
    while len(states) <= length and not done:
        states.append((OPEN - gains) * states[-1])
        done = bool(fallen(states[-1]))
    states = np.array(states)
    return Trajectory(
        states,
        actions=-np.asarray(gains) * states[:-1],
        params=gains,
        rewards=cost(states[1:]),
        dt=0.1,
        terminated=done,
    )


class Plant:
    def __init__(self):
        self.flown = []

    def reset(self, n, random_state=None):
        return np.random.default_rng(random_state).uniform(0.5, 1.5, size=(n, 2))

    def rollout(self, initial_states, params, length, policy=None, *, random_state=None):
        self.flown.append((initial_states[0], params[0], length, policy, random_state))
        return TrajectoryDataset(
            [fly(params[0], initial_states[0], length)],
            state_names=["x", "y"],
            param_names=["k_x", "k_y"],
        )


def contents(search, folder):
    """All that a search has asked for and was told, as it would be saved."""
    path = folder / "contents.npz"
    search.save(path)
    with np.load(path) as file:
        return {name: file[name] for name in file.files if name != "trials"} | {
            "states": search.trials_.states if len(search.returns_) else None
        }


def same_contents(a, b):
    return a.keys() == b.keys() and all(
        np.array_equal(a[key], b[key], equal_nan=a[key].dtype.kind == "f")
        if isinstance(a[key], np.ndarray)
        else a[key] is b[key]
        for key in a
    )


def tuned_by_a_model(random_state):
    """A search whose model learns this plant from two gains."""
    model = OneStepRegressor(LinearRegression(), policy=policy)
    return PolicySearch(
        model,
        bounds=BOUNDS,
        reward=cost,
        horizon=HORIZON,
        n_initial=2,
        n_evaluations=300,
        random_state=random_state,
    )
