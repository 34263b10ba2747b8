"""Systems with known measurement and process noise."""

import numpy as np

from trajlearn import TrajectoryDataset

A = np.array([[0.95, 0.1], [-0.15, 0.9]])
B = np.array([[0.05], [0.3]])
STD = np.array([0.3, 0.2])


def noisy_linear(n=50, *, seed=0, measurement=STD, process=(0.0, 0.0), lengths=(30, 40)):
    """s' = A s + B a + process noise, measured with noise; ragged. The measured, and the true."""
    rng = np.random.default_rng(seed)
    states, actions = [], []
    for steps in rng.integers(lengths[0], lengths[1] + 1, size=n):
        s, a = [rng.normal(size=2)], []
        for _ in range(steps):
            a.append(rng.normal(size=1))
            s.append(A @ s[-1] + B @ a[-1] + process * rng.normal(size=2))
        states.append(np.array(s))
        actions.append(np.array(a))
    measured = [s + measurement * rng.normal(size=s.shape) for s in states]
    build = TrajectoryDataset.from_arrays
    return build(measured, actions=actions), build(states, actions=actions)


def oscillators(n=20, *, seed=0, steps=60, noise=0.0):
    """Positions of pendulums under linear feedback, by Euler's method: measured, and true."""
    rng = np.random.default_rng(seed)
    states, actions, params = [], [], []
    for _ in range(n):
        gains = rng.uniform([1.0, 0.5], [3.0, 2.0])
        s, a = [np.array([rng.normal(), 0.1 * rng.normal()])], []
        for _ in range(steps):
            x, v = s[-1]
            a.append([-gains @ s[-1]])
            s.append(np.array([x + 0.1 * v, v + 0.1 * (a[-1][0] - np.sin(x))]))
        states.append(s)
        actions.append(a)
        params.append(gains)
    fields = {"actions": actions, "params": params, "dt": 0.1, "state_names": ["x", "v"]}
    true = TrajectoryDataset.from_arrays(states, **fields)
    measured = np.array(states) + noise * rng.normal(size=np.shape(states))
    return TrajectoryDataset.from_arrays(measured, **fields).select_states(["x"]), true
