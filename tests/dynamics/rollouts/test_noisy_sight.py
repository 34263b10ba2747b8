"""A controller that acts on noisy states: what it sees in a roll-out is noisy, too."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LinearRegression

from tests.dynamics.noisy_systems import oscillators
from tests.dynamics.systems import A, B, gain_policy
from trajlearn import OneStepRegressor, TrajectoryDataset
from trajlearn.dynamics._denoising.errors_in_variables import with_states
from trajlearn.dynamics._rollouts.noisy_sight import noisy_sight, paired

NOISE = np.array([0.3, 0.2])


def limited(states, params, times):
    return np.clip(3 * gain_policy(states, params, times), -0.3, 0.3)


def controlled(n=30, *, policy=limited, seed=0, steps=12, noise=NOISE):
    """s' = A s + B a, under a policy of measurements with noise, which are logged."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.2, 0.9, size=(n, 2))
    states, seen, actions = [rng.normal(size=(n, 2))], [], []
    for t in range(steps + 1):
        seen.append(states[-1] + noise * rng.normal(size=(n, 2)))
        actions.append(policy(seen[-1], theta, np.full(n, float(t))))
        states.append(states[-1] @ A.T + actions[-1] @ B.T)
    logged = {"actions": np.stack(actions[:-1], axis=1), "params": theta}
    return [
        TrajectoryDataset.from_arrays(np.stack(some, axis=1), **logged)
        for some in (states[:-1], seen)
    ]


class Sure(LinearRegression):
    """Without noise in its step."""

    def predict(self, X, return_std=False):
        mean = super().predict(X)
        return (mean, np.zeros_like(mean)) if return_std else mean


class Denoised(OneStepRegressor):
    """With states and noise that are known."""

    def _fit_states(self, ds, weight, groups):
        denoise, self.denoise = self.denoise, None
        super()._fit_states(self.true_, weight, groups)
        self.denoise = denoise
        self.noisy_, self.measurement_noise_ = True, NOISE

    def smooth(self, X):
        return self.true_


def model(true, **settings):
    estimator = Denoised(Sure(), denoise="em", random_state=0, **settings)
    estimator.true_ = true
    return estimator


def test_mean_is_that_of_noisy_roll_outs_of_the_plant():
    true, seen = controlled()
    fitted = model(true, policy=limited, policy_sees="measurements", n_particles=2000).fit(seen)
    some = true[:3]
    mean = fitted.predict(some).mean
    rng, plant = np.random.default_rng(5), np.zeros((3, 12, 2))
    s = np.tile(some.states[some.offsets[:-1]], (20000, 1))
    theta = np.tile(some.params, (20000, 1))
    for k in range(12):
        a = limited(s + NOISE * rng.normal(size=s.shape), theta, np.zeros(len(s)))
        s = s @ A.T + a @ B.T
        plant[:, k] = s.reshape(20000, 3, 2).mean(axis=0)
    assert_allclose(mean, plant, atol=0.012)
    # without noise the controller is too strong
    fitted.set_params(policy_sees="states")
    assert np.abs(fitted.predict(some).mean - plant).max() > 0.05


def test_mean_is_the_same_bits_alone_and_again_and_with_samples():
    true, seen = controlled()
    fitted = model(true, policy=limited, policy_sees="measurements").fit(seen)
    mean = fitted.predict(true[:4]).mean
    assert (fitted.predict(true[:4]).mean == mean).all()
    assert (fitted.predict(true[2:3]).mean == mean[2:3]).all()
    assert (fitted.predict(true[:4], n_samples=2, random_state=1).mean == mean).all()


def test_noise_that_enters_linearly_leaves_the_mean():
    true, seen = controlled(policy=gain_policy)
    fitted = model(true, policy=gain_policy, policy_sees="measurements", n_particles=5).fit(seen)
    noisy = fitted.predict(true).mean
    assert_allclose(noisy, fitted.set_params(policy_sees="states").predict(true).mean, atol=1e-9)


def test_samples_differ_by_what_the_policy_saw():
    true, seen = controlled()
    fitted = model(true, policy=limited, policy_sees="measurements").fit(seen)
    samples = fitted.predict(true, n_samples=40, random_state=0).samples
    spread = samples.std(axis=0)[:, -1]
    assert (spread > 0.01).all()
    # of each start on its own
    assert not np.allclose(samples[:, 0] - samples[0, 0], samples[:, 1] - samples[0, 1])


def test_clone_is_learned_from_what_the_controller_acted_on():
    true, seen = controlled()
    by_measurement = model(true, policy="clone", policy_sees="measurements").fit(seen)
    assert by_measurement.policy_.estimator.exact_.all()
    by_state = model(true, policy="clone").fit(seen)
    assert not by_state.policy_.estimator.exact_.any()
    given = model(true, policy=limited, policy_sees="measurements").fit(seen)
    assert_allclose(by_measurement.predict(true).mean, given.predict(true).mean, atol=1e-6)


def test_clone_is_learned_from_measurements_that_were_smoothed_before():
    true, seen = controlled()
    smoothed = with_states(seen, true.states)
    fitted = model(true, policy="clone", policy_sees="measurements").fit(smoothed)
    assert fitted.policy_.estimator.exact_.all()


def test_logged_actions_are_what_they_are():
    true, seen = controlled()
    fitted = model(true, policy=limited, policy_sees="measurements").fit(seen)
    logged = fitted.predict(true, actions="logged").mean
    assert_allclose(logged, true.states.reshape(30, 13, 2)[:, 1:], atol=1e-8)


def test_paired_noise_is_opposite_and_the_same_at_every_start():
    draw = paired(3, seed=0)
    first, second = draw((12, 2)).reshape(4, 3, 2), draw((12, 2)).reshape(4, 3, 2)
    assert (first[:2] == -first[2:]).all()
    assert (first == first[:, :1]).all()
    assert not (first == second).any()


def test_sight_is_scaled_by_the_noise():
    control = noisy_sight(lambda s, k, past: s, np.array([2.0, 0.0]), np.ones)
    assert (control(np.zeros((3, 2)), 0, {}) == [2.0, 0.0]).all()


@pytest.mark.parametrize("propagation", ["moment", "unscented"])
def test_gaussians_cannot_carry_it(propagation):
    true, seen = controlled()
    fitted = model(true, policy=limited, policy_sees="measurements", propagation=propagation)
    with pytest.raises(ValueError, match="cannot carry the noise of what a policy sees"):
        fitted.fit(seen).predict(true)


def test_measurements_need_to_be_denoised():
    with pytest.raises(ValueError, match='set denoise="em"'):
        OneStepRegressor(LinearRegression(), policy_sees="measurements").fit(controlled()[1])
    with pytest.raises(ValueError, match='set denoise="em"'):
        OneStepRegressor(policy_sees="measurements").fit(np.zeros((9, 3)), np.zeros((9, 2)))


def test_set_after_a_fit_without_noise_it_is_refused():
    true, seen = controlled()
    fitted = OneStepRegressor(LinearRegression(), policy=limited).fit(seen)
    with pytest.raises(ValueError, match='set denoise="em"'):
        fitted.set_params(policy_sees="measurements").predict(true)
    with pytest.raises(NotFittedError, match='fit again with denoise="em"'):
        fitted.set_params(denoise="em").predict(true)


def test_set_after_a_fit_with_latent_velocities_it_is_refused():
    ds, _ = oscillators(8, noise=0.02)
    fitted = OneStepRegressor(
        LinearRegression(), latent_velocities=True, policy=lambda s, p, t: -s[:, :1]
    ).fit(ds)
    fitted.set_params(latent_velocities=False, denoise="em", policy_sees="measurements")
    with pytest.raises(ValueError, match="which velocities the controller acted on"):
        fitted.predict(ds)
    # another fit looks for velocities no more
    assert fitted.fit(ds).predict(ds).mean.shape == (8, 60, 1)
