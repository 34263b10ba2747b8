import numpy as np
import pytest
import torch

from trajlearn.regressors._gp_models import (
    Hyperparameters,
    build_kernel,
    exact_objective,
    sparse_objective,
)
from trajlearn.regressors._gp_posterior import exact_posterior, predict_rows, sparse_posterior


def wave(n, *, seed=0):
    """Rows of a noisy function of two inputs."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, size=(n, 2))
    return X, np.sin(2 * X[:, 0]) + 0.3 * X[:, 1] ** 2 + 0.1 * rng.normal(size=n)


def slopes(objective, at):
    """Central differences; the step is large because Matern 1/2 magnifies round-off."""
    steps = 1e-4 * np.eye(len(at))
    return [(objective(at + step)[0] - objective(at - step)[0]) / 2e-4 for step in steps]


@pytest.mark.parametrize("kernel", ["rbf", "matern12", "matern32", "matern52"])
def test_gradients_and_values(kernel):
    X, y = wave(25)
    theta = np.array([0.1, 0.5, 0.2, -2.0])
    exact = exact_objective(build_kernel(kernel, 2), X, y)
    np.testing.assert_allclose(exact(theta)[1], slopes(exact, theta), atol=5e-3)
    sparse_ = sparse_objective(build_kernel(kernel, 2), X, y, 4)
    flat = np.concatenate([theta, X[:4].ravel() + 0.1])
    np.testing.assert_allclose(sparse_(flat)[1], slopes(sparse_, flat), atol=5e-3)
    # the closed-form posteriors, which share no code with the objectives, report the same
    h = Hyperparameters.from_theta(theta)
    direct = exact_posterior(kernel, X, y, h)
    assert exact(theta)[0] == pytest.approx(-direct.log_likelihood, rel=1e-8)
    bound = sparse_posterior(kernel, X[:4] + 0.1, X, y, h).log_likelihood
    assert sparse_(flat)[0] == pytest.approx(-bound, rel=1e-8)
    assert bound < direct.log_likelihood


def test_sparse_with_every_row_as_inducing_point_is_exact():
    X, y = wave(50)
    h = Hyperparameters(np.array([0.8, 1.1]), 1.5, 0.02)
    exact, sparse_ = exact_posterior("rbf", X, y, h), sparse_posterior("rbf", X, X, y, h)
    new = wave(30, seed=1)[0]
    ours = predict_rows("rbf", new, X, h, sparse_.weights, sparse_.root)
    truth = predict_rows("rbf", new, X, h, exact.weights, exact.root)
    np.testing.assert_allclose(ours, truth, atol=1e-4)
    assert sparse_.log_likelihood == pytest.approx(exact.log_likelihood, abs=1e-3)


def test_agrees_with_gpytorch():
    import gpytorch

    X, y = wave(40)
    theta = np.array([-0.2, 0.3, 0.4, -3.0])
    h = Hyperparameters.from_theta(theta)

    class Model(gpytorch.models.ExactGP):
        def __init__(self, x, y, likelihood):
            super().__init__(x, y, likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            base = gpytorch.kernels.RBFKernel(ard_num_dims=2)
            self.covar_module = gpytorch.kernels.ScaleKernel(base)

        def forward(self, x):
            mean, covariance = self.mean_module(x), self.covar_module(x)
            return gpytorch.distributions.MultivariateNormal(mean, covariance)

    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    model = Model(torch.tensor(X), torch.tensor(y), likelihood).double()
    model.covar_module.base_kernel.lengthscale = torch.tensor(h.length_scales)
    model.covar_module.outputscale = h.signal_variance
    likelihood.noise = h.noise_variance
    evidence = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    value = 40 * evidence(model(*model.train_inputs), model.train_targets).item()
    posterior = exact_posterior("rbf", X, y, h)
    assert posterior.log_likelihood == pytest.approx(value, rel=1e-8)
    assert exact_objective(build_kernel("rbf", 2), X, y)(theta)[0] == pytest.approx(-value)

    model.eval(), likelihood.eval()
    new = wave(15, seed=1)[0]
    with torch.no_grad():
        theirs = likelihood(model(torch.tensor(new)))
    mean, variance = predict_rows("rbf", new, X, h, posterior.weights, posterior.root)
    np.testing.assert_allclose(mean, theirs.mean.numpy(), atol=1e-6)
    std = np.sqrt(variance + h.noise_variance)
    np.testing.assert_allclose(std, theirs.stddev.numpy(), atol=1e-6)
