"""A Gaussian process from controller parameters to the return of a trial (BoTorch)."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from trajlearn.regressors._threads import threads_for

__all__ = ["ACQUISITIONS", "ReturnGP", "fit_return_gp", "propose", "same_bits"]

Floats = NDArray[np.float64]

ACQUISITIONS = ("logei", "ucb")
# of the upper confidence bound: mean + 2 std
_BETA = 4.0
# starts of the optimisation of the acquisition, of the best among so many Sobol points
_RESTARTS, _RAW_SAMPLES = 10, 512
# variance of exact returns in units of theirs, which a Cholesky factor needs
_NUGGET = 1e-6


@dataclass(frozen=True, eq=False)
class ReturnGP:
    """A fitted process of standardised returns on the unit cube.

    Parameters
    ----------
    model : botorch model
    points : ndarray of shape (n, p)
        Trials, in the unit cube.
    centre, unit : float
        Returns are ``centre + unit * z``.
    incumbent : float
        What a proposal is to improve on, as z.
    """

    model: Any
    points: Floats
    centre: float
    unit: float
    incumbent: float

    def moments(self, points: Floats, *, noise: bool) -> tuple[Floats, Floats]:
        """Mean and std of the return (m,) at points of the unit cube, of one trial if `noise`."""
        with torch.no_grad():
            posterior = self.model.posterior(torch.from_numpy(points), observation_noise=noise)
            mean, variance = posterior.mean[:, 0].numpy(), posterior.variance[:, 0].numpy()
        return self.centre + self.unit * mean, self.unit * np.sqrt(variance)


def fit_return_gp(points: Floats, returns: Floats, *, noisy: bool) -> ReturnGP:
    """Fit the kernel, and the noise if there is some, to trials."""
    from botorch.exceptions import InputDataWarning
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from gpytorch.mlls import ExactMarginalLogLikelihood

    centre, unit = float(returns.mean()), _unit(returns)
    x, z = torch.from_numpy(points), torch.from_numpy((returns - centre) / unit)[:, None]
    with warnings.catch_warnings():
        # equal returns cannot be brought to a variance of 1
        warnings.simplefilter("ignore", InputDataWarning)
        model = SingleTaskGP(
            x,
            z,
            train_Yvar=None if noisy else torch.full_like(z, _NUGGET),
            # BoTorch's own cannot standardise a single return
            outcome_transform=None,
        )
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    with torch.no_grad():
        best = model.posterior(x).mean if noisy else z
    return ReturnGP(model, points, centre, unit, float(best.max()))


def _unit(returns: Floats) -> float:
    """Standard deviation of the returns; the size of a single one, or of equal ones."""
    size = float(np.abs(returns).max())
    std = float(returns.std(ddof=1)) if len(returns) > 1 else 0.0
    return std if std > 1e-12 * size else size or 1.0


def propose(gp: ReturnGP, acquisition: str, seed: int) -> Floats:
    """Point of the unit cube (p,) where the acquisition is greatest."""
    from botorch.acquisition import LogExpectedImprovement, UpperConfidenceBound
    from botorch.optim import optimize_acqf

    function = (
        LogExpectedImprovement(gp.model, best_f=gp.incumbent)
        if acquisition == "logei"
        else UpperConfidenceBound(gp.model, beta=_BETA)
    )
    cube = torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, gp.points.shape[1])
    with warnings.catch_warnings():
        # where the acquisition is flat, a line search fails; the best point so far still counts
        warnings.filterwarnings("ignore", "Optimization failed", RuntimeWarning)
        found, _ = optimize_acqf(
            function,
            bounds=cube,
            q=1,
            num_restarts=_RESTARTS,
            raw_samples=_RAW_SAMPLES,
            options={"seed": seed},
        )
    point: Floats = found[0].numpy()
    return point


@contextmanager
def same_bits(seed: int) -> Iterator[None]:
    """Seed torch and take one thread inside; outside nothing has happened.

    BoTorch draws from torch's global generator, and sums on several threads differ in bits.
    """
    with threads_for(0.0), torch.random.fork_rng(devices=[]):
        # not torch.manual_seed, which also seeds every accelerator
        torch.random.default_generator.manual_seed(seed)
        yield
