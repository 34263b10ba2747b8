"""What a Gaussian process maximises over its hyper-parameters: one output, standardised data.

L-BFGS sees a flat vector ``theta = log([length scales (d), signal variance, noise variance])``;
the covariance functions and their derivatives are gpytorch's.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Objective = Callable[[Floats], tuple[float, Floats]]

# Relative diagonal added to the inducing points' covariance: neighbouring points are
# nearly collinear under a smooth kernel.
JITTER = 1e-7

_MATERN_NU = {"matern12": 0.5, "matern32": 1.5, "matern52": 2.5}
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class Hyperparameters:
    """Hyper-parameters of one output, in standardised units."""

    length_scales: Floats
    signal_variance: float
    noise_variance: float

    @classmethod
    def from_theta(cls, theta: Floats) -> "Hyperparameters":
        """Read the flat vector of logarithms."""
        values = np.exp(theta)
        return cls(values[:-2], float(values[-2]), float(values[-1]))


@dataclass(frozen=True)
class LogNormalPrior:
    """Independent log-normal priors, and the box in which L-BFGS searches.

    Weak, but proper: an input that does not matter, a constant target or a single row
    leaves part of theta undetermined by the data. Standardised inputs lie about
    ``sqrt(2 d)`` apart, so the length scales' median is ``sqrt(d)``.
    """

    mean: Floats
    std: Floats
    lower: Floats
    upper: Floats

    @classmethod
    def for_inputs(cls, n_features: int) -> "LogNormalPrior":
        """Make the prior of a GP on `n_features` standardised inputs."""

        def stack(length_scale: float, signal: float, noise: float) -> Floats:
            return np.array([length_scale] * n_features + [signal, noise])

        return cls(
            mean=stack(0.5 * np.log(n_features), 0.0, np.log(1e-2)),
            std=stack(np.sqrt(3.0), 2.0, 3.0),
            # simulated targets are exact, but for ten thousandths of their spread
            lower=np.log(stack(1e-2, 1e-4, 1e-8)),
            upper=np.log(stack(1e4, 1e4, 1e1)),
        )

    def penalty(self, theta: Floats) -> tuple[float, Floats]:
        """Minus the log density up to a constant, and its gradient."""
        z = (theta - self.mean) / self.std
        return 0.5 * float(z @ z), z / self.std

    def starts(self, normals: Floats) -> Floats:
        """The prior's median, then draws made of standard normals (k, d + 2): (1 + k, d + 2)."""
        draws = self.mean + self.std * normals
        return np.clip(np.vstack([self.mean, draws]), self.lower, self.upper)


def build_kernel(name: str, n_features: int) -> Any:
    """Make gpytorch's ARD kernel whose raw parameters are logarithms, in float64."""
    from gpytorch.constraints import Positive
    from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel

    def log_scale() -> Any:
        return Positive(transform=torch.exp, inv_transform=torch.log)

    shared = {"ard_num_dims": n_features, "lengthscale_constraint": log_scale()}
    base = RBFKernel(**shared) if name == "rbf" else MaternKernel(nu=_MATERN_NU[name], **shared)
    return ScaleKernel(base, outputscale_constraint=log_scale()).double()


def _load(kernel: Any, theta: Floats) -> None:
    """Put the flat vector into the kernel and clear its gradients."""
    with torch.no_grad():
        kernel.base_kernel.raw_lengthscale.copy_(torch.from_numpy(theta[None, :-2]))
        kernel.raw_outputscale.fill_(theta[-2])
    kernel.zero_grad()


def _grad(parameter: Any) -> Floats:
    """Flat gradient of the last backward pass."""
    gradient: Floats = parameter.grad.numpy().ravel()
    return gradient


def _gradient(kernel: Any) -> list[Floats]:
    """Gradients with respect to the kernel's part of theta, in its order."""
    return [_grad(kernel.base_kernel.raw_lengthscale), _grad(kernel.raw_outputscale)]


def cholesky(matrix: torch.Tensor) -> torch.Tensor:
    """Lower Cholesky factor; a little is added to the diagonal where round-off asks for it."""
    from linear_operator.utils.cholesky import psd_safe_cholesky

    with warnings.catch_warnings():
        # less than the noise of exact data need not be told
        warnings.filterwarnings("ignore", r"A not p\.d\., added jitter of 1\.0e-0[78]")
        factor: torch.Tensor = psd_safe_cholesky(matrix)
    return factor


def exact_objective(kernel: Any, inputs: Floats, targets: Floats) -> Objective:
    """Minus the log marginal likelihood, Rasmussen and Williams (2006), eq. 5.8 and 5.9.

    The derivative with respect to the covariance matrix is written down, which costs a
    quarter of differentiating through the Cholesky factor; autograd does the rest.
    """
    x, y = torch.tensor(inputs), torch.tensor(targets)  # copies, aligned: same data, same bits
    n = len(y)

    def objective(theta: Floats) -> tuple[float, Floats]:
        _load(kernel, theta)
        noise = float(np.exp(theta[-1]))
        covariance = kernel(x).to_dense()
        with torch.no_grad():
            noisy = covariance.detach().clone()
            noisy.diagonal().add_(noise)
            factor = cholesky(noisy)
            weights = torch.cholesky_solve(y[:, None], factor)[:, 0]
            value = 0.5 * y @ weights + factor.diagonal().log().sum() + 0.5 * n * _LOG_2PI
            slope = torch.cholesky_inverse(factor)
            slope = 0.5 * (slope - torch.outer(weights, weights))
        covariance.backward(slope)
        noise_slope = noise * slope.diagonal().sum().item()
        return value.item(), np.concatenate([*_gradient(kernel), [noise_slope]])

    return objective


def sparse_objective(kernel: Any, inputs: Floats, targets: Floats, m: int) -> Objective:
    """Minus Titsias' (2009) collapsed bound as a function of theta and m inducing points.

    For Gaussian noise the best variational distribution is known in closed form, so no
    steps are spent on it. The points follow theta in the flat vector.
    """
    x, y = torch.tensor(inputs), torch.tensor(targets)  # copies, aligned: same data, same bits
    n, d = x.shape
    n_theta = d + 2
    eye = torch.eye(m, dtype=x.dtype)

    def objective(flat: Floats) -> tuple[float, Floats]:
        _load(kernel, flat[:n_theta])
        log_noise = torch.tensor(flat[n_theta - 1], requires_grad=True)
        points = torch.tensor(flat[n_theta:].reshape(m, d), requires_grad=True)
        noise = log_noise.exp()
        signal = kernel.outputscale
        factor = cholesky(kernel(points).to_dense() + JITTER * signal * eye)
        cross = kernel(points, x).to_dense()
        a = torch.linalg.solve_triangular(factor, cross, upper=False) / noise.sqrt()
        inner = cholesky(eye + a @ a.T)
        c = torch.linalg.solve_triangular(inner, (a @ y)[:, None], upper=False) / noise.sqrt()
        value = (
            0.5 * n * (_LOG_2PI + log_noise)
            + inner.diagonal().log().sum()
            + 0.5 * (y @ y / noise - c.square().sum())
            + 0.5 * (n * signal / noise - a.square().sum())
        )
        value.backward()
        return value.item(), np.concatenate([*_gradient(kernel), _grad(log_noise), _grad(points)])

    return objective
