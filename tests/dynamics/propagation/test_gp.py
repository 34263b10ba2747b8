"""Exact moments of a Gaussian process along a roll-out: PILCO's propagation."""

import warnings

import numpy as np
import pytest

from trajlearn import GPRegressor, OneStepRegressor, TrajectoryDataset
from trajlearn.dynamics import one_step
from trajlearn.exceptions import DivergenceWarning


def pendulum(n=6, steps=12, seed=0):
    """s' = s + 0.3 (v, -2 sin 2 s - 0.3 v + a) + noise; few rows, so that the GP is not sure."""
    rng = np.random.default_rng(seed)
    states, actions = np.empty((n, steps + 1, 2)), rng.normal(size=(n, steps, 1))
    states[:, 0] = rng.uniform(-1.5, 1.5, size=(n, 2))
    for t in range(steps):
        s, v = states[:, t].T
        push = np.stack([v, -2.0 * np.sin(2 * s) - 0.3 * v + actions[:, t, 0]], axis=1)
        states[:, t + 1] = states[:, t] + 0.3 * push + 0.2 * rng.normal(size=(n, 2))
    return TrajectoryDataset.from_arrays(states, actions=actions, params=np.ones((n, 1)))


def policy(states, params, times):
    return -0.8 * params * states[:, :1] - 0.4 * states[:, 1:]


@pytest.fixture(scope="module", params=["change", "previous", "state, sparse"])
def model(request):
    settings = {
        "change": {},
        "previous": {"inputs": ("action", "previous")},
        "state, sparse": {"target": "state"},
    }[request.param]
    sparse = {"max_exact": 40, "n_inducing": 30} if "sparse" in request.param else {}
    gp = GPRegressor(n_restarts=0, max_iter=30, random_state=0, **sparse)
    fitted = OneStepRegressor(gp, policy=policy, propagation="moment", **settings)
    return fitted.fit(pendulum(n=8 if sparse else 6))


def test_two_steps_are_those_of_many_particles(model):
    # the first step is Gaussian, so that the second one is exact
    ds, n = pendulum(3, seed=1), 6000
    found = model.predict(ds, horizon=2, return_std=True, n_samples=n, random_state=0)
    model.set_params(propagation="tsinf", n_particles=n)
    try:
        particles = model.predict(
            ds, horizon=2, return_std=True, n_samples=n, random_state=1
        ).samples
    finally:
        model.set_params(propagation="moment")
    std = particles.std(axis=0)
    off = (found.mean - particles.mean(axis=0)) / (std / np.sqrt(n))
    assert np.abs(off).max() < 4.5
    np.testing.assert_allclose(found.std, std, rtol=0.05)

    def correlation(paths):
        flat = paths.transpose(1, 0, 2, 3).reshape(len(ds), n, 4)
        return np.array([np.corrcoef(each.T) for each in flat])

    np.testing.assert_allclose(correlation(found.samples), correlation(particles), atol=0.08)


def test_more_steps_stay_near_the_particles(model):
    ds, n = pendulum(2, seed=1), 1500
    found = model.predict(ds, horizon=5, return_std=True, n_samples=n, random_state=0)
    model.set_params(propagation="tsinf", n_particles=n)
    particles = model.predict(ds, horizon=5, n_samples=n, random_state=1).samples
    model.set_params(propagation="moment")
    std = particles.std(axis=0)
    np.testing.assert_allclose(found.std, std, rtol=0.15)
    assert (np.abs(found.mean - particles.mean(axis=0)) / std).max() < 0.15
    np.testing.assert_allclose(found.samples.std(axis=0), found.std, rtol=0.1)


def test_exact_moments_are_not_those_of_slopes(model, monkeypatch):
    ds = pendulum(3, seed=1)
    exact = model.predict(ds, horizon=4, return_std=True)
    monkeypatch.setattr(one_step, "has_exact_moments", lambda learner: False)
    by_slopes = model.predict(ds, horizon=4, return_std=True)
    # a known start: one step is the same
    np.testing.assert_allclose(by_slopes.mean[:, 0], exact.mean[:, 0], atol=1e-9)
    np.testing.assert_allclose(by_slopes.std[:, 0], exact.std[:, 0], rtol=1e-6)
    assert np.abs(by_slopes.std[:, 1] / exact.std[:, 1] - 1).max() > 0.02
    assert (np.abs(by_slopes.mean - exact.mean) / exact.std).max() > 0.02


def test_the_same_bits_alone_and_whatever_is_asked(model):
    ds = pendulum(3, seed=1)
    whole = model.predict(ds, horizon=5, return_std=True)
    np.testing.assert_array_equal(model.predict(ds, horizon=5), whole.mean)
    for i in range(3):
        alone = model.predict(ds[[i]], horizon=5, return_std=True)
        np.testing.assert_array_equal(alone.mean[0], whole.mean[i])
        np.testing.assert_array_equal(alone.std[0], whole.std[i])


def test_replayed_actions_have_no_spread(model):
    ds = pendulum(2, seed=1)
    forecast = model.predict(ds, actions="logged", return_std=True, horizon=3)
    assert np.isfinite(forecast.std).all()
    assert (forecast.std > 0).all()


def test_other_kernels_go_by_slopes():
    gp = GPRegressor(kernel="matern52", n_restarts=0, max_iter=20, random_state=0)
    model = OneStepRegressor(gp, policy=policy, propagation="moment").fit(pendulum())
    forecast = model.predict(pendulum(2, seed=1), horizon=4, return_std=True)
    assert (forecast.std > 0).all()
    assert np.isfinite(forecast.mean).all()


def test_a_start_that_is_far_away_leaves_the_others_alone(model):
    ds = pendulum(3, seed=1)
    states = [e.states.copy() for e in ds]
    states[1] *= 1e12
    far = TrajectoryDataset.from_arrays(states, actions=[e.actions for e in ds], params=ds.params)
    with warnings.catch_warnings():
        # a GP of the state itself, not of the change, comes back to the data
        warnings.simplefilter("ignore", DivergenceWarning)
        found = model.predict(far, return_std=True, horizon=3)
    whole = model.predict(ds, return_std=True, horizon=3)
    np.testing.assert_array_equal(found.mean[[0, 2]], whole.mean[[0, 2]])
    np.testing.assert_array_equal(found.std[[0, 2]], whole.std[[0, 2]])
    assert np.isposinf(found.mean[1]).all() == (model.target == "change")
    assert not np.isnan(found.std).any()
