"""Measurement and process noise of a learned step: detection, estimate, likelihood."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from sklearn.covariance import ledoit_wolf

from trajlearn.dynamics._denoising.smoother import Posterior, Problem, smooth_states

__all__ = [
    "NoiseModel",
    "ResidualNoise",
    "least_variance",
    "likeliest",
    "residual_noise",
    "start_of",
]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# A state has measurement noise if its trace in the next residual is so many standard errors above
# zero, and that in the one after it, where noise leaves none, is less than this share of it, ...
_ERRORS, _LATER = 4.0, 0.5
# ... and it explains at least this share of the variance of the residuals.
_SHARE = 0.1
# Steps whose residuals are taken together for a standard error: others are nearly independent.
_BLOCK = 20
# Least variance of process and of measurement noise, in that of the residuals.
_LEAST = 1e-5
# Episodes that it takes to know where others begin.
_FEWEST = 5
# How far one search may change logarithms of variances, and how often it may try.
_REACH, _TRIES = (-12.0, 6.0), 12


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Gaussian noise about a learned step, and where episodes begin."""

    measurement: Floats
    """Variances of what is measured (m,)."""
    process: Floats
    """Variances of what the step leaves open (d,)."""
    start_mean: Floats
    """Of the first state of an episode (d,)."""
    start_covariance: Floats
    """(d, d)."""
    mean: Floats
    """Of all states (d,)."""
    spread: Floats
    """Variance of all states, widened until it says next to nothing of any (d,)."""

    def start(self, first: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Mean (n, d) and covariance (n, d, d) of states, before they are measured.

        Parameters
        ----------
        first : ndarray of shape (n,)
            Which begin an episode as those in training did; of the others nothing is known.
        """
        mean = np.where(first[:, None], self.start_mean, self.mean)
        anywhere = np.diag(self.spread)
        return mean, np.where(first[:, None, None], self.start_covariance, anywhere)

    def smoothed(self, problem: Problem, first: NDArray[np.bool_]) -> Posterior:
        """States given all measurements; `first` as in `start`."""
        mean, covariance = self.start(first)
        return smooth_states(
            problem,
            measurement=self.measurement,
            process=self.process,
            start_mean=mean,
            start_covariance=covariance,
        )


@dataclass(frozen=True, eq=False)
class ResidualNoise:
    """What the residuals of one step tell of the noise."""

    measurement: Floats
    """Variance of the measurement noise of each state, possibly negative (d,)."""
    residual: Floats
    """Variance of the residuals (d,)."""
    found: NDArray[np.bool_]
    """States with measurement noise that matters (d,)."""


def residual_noise(residuals: Floats, slopes: Floats, episode: Ints) -> ResidualNoise:
    r"""Tell measurement noise from residuals of a step, e_t = y_{t+1} - f(y_t).

    The error v_{t+1} of a measurement enters e_t as it is and e_{t+1} times minus the slopes
    F_{t+1}, so that E[e_{t+1} e_t'] = -F_{t+1} R. The variances on the diagonal of R are fitted to
    all elements of these products, in units of the residuals. Process noise leaves no such trace,
    and what the learner misses leaves another one, which lasts for more than a step.

    Parameters
    ----------
    residuals : ndarray of shape (n, d)
    slopes : ndarray of shape (n, d, d)
    episode : ndarray of shape (n,)
        Episode of each row, whose steps follow each other.

    Returns
    -------
    ResidualNoise
    """
    variance = np.maximum(np.mean(residuals**2, axis=0), np.finfo(np.float64).tiny)
    if len(residuals) < 3:
        return ResidualNoise(np.zeros_like(variance), variance, np.zeros(len(variance), bool))
    steep = slopes / np.sqrt(variance)[:, None]
    weight = np.einsum("nij,nij->j", steep, steep) * np.mean(episode[1:] == episode[:-1])
    # a state that nothing depends on leaves no trace
    weight = np.where(weight > 0, weight, np.inf)
    traces = []
    for lag in (1, 2):
        follows = episode[lag:] == episode[:-lag]
        scaled = residuals[lag:] / np.sqrt(variance) * follows[:, None]
        traces.append(-np.einsum("ni,nij,nj->nj", scaled, steep[lag:], residuals[:-lag]))
    estimate, later = (trace.sum(axis=0) / weight for trace in traces)
    blocks = np.add.reduceat(traces[0], np.arange(0, len(traces[0]), _BLOCK))
    error = np.sqrt(np.sum((blocks - blocks.mean(axis=0)) ** 2, axis=0)) / weight
    sure = (estimate > _ERRORS * error) & (np.abs(later) < _LATER * estimate)
    sensed = np.where(sure, estimate, 0.0)
    share = (sensed + np.mean(slopes**2, axis=0) @ sensed) / variance
    return ResidualNoise(estimate, variance, sure & (share > _SHARE))


def likeliest(
    problem: Problem, first: NDArray[np.bool_], noise: NoiseModel, least: Floats
) -> NoiseModel:
    """Variances that make the measurements most likely, about a step that is held.

    The gradient of the likelihood is that of expectation-maximisation, but the search goes as far
    as it pays: steps of expectation-maximisation are the shorter the less process noise there is.

    Parameters
    ----------
    problem : Problem
    first : ndarray of shape (n,)
        As in `NoiseModel.start`.
    noise : NoiseModel
        Where to begin, and the start.
    least : ndarray of shape (d,)
        Smallest variances to consider.

    Returns
    -------
    NoiseModel
    """
    m = len(noise.measurement)
    lowest: Floats = np.log(np.concatenate([least[:m], least]))
    begin: Floats = np.log(np.concatenate([noise.measurement, noise.process]))
    begin = np.maximum(begin, lowest)

    def of(logs: Floats) -> NoiseModel:
        variances = np.exp(logs)
        return replace(noise, measurement=variances[:m], process=variances[m:])

    def with_slope(logs: Floats) -> tuple[Any, Any]:
        candidate = of(logs)
        found = candidate.smoothed(problem, first)
        slope = np.concatenate(
            [
                found.n_measured - found.missed / candidate.measurement,
                found.n_steps - found.pushed / candidate.process,
            ]
        )
        return found.deviance / found.n_measured, slope / found.n_measured

    bounds = list(zip(np.maximum(begin + _REACH[0], lowest), begin + _REACH[1], strict=True))
    how: dict[str, Any] = {"method": "L-BFGS-B", "options": {"maxfun": _TRIES, "ftol": 1e-6}}
    return of(np.asarray(minimize(with_slope, begin, jac=True, bounds=bounds, **how).x))


def least_variance(residual: Floats) -> Floats:
    """Variance (d,) below which noise counts as none, for residuals of some variance."""
    return np.asarray(_LEAST * residual)


def start_of(means: Floats, covariances: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Mean (d,) and covariance (d, d) of the first state of another episode.

    The spread of the smoothed starts and what is not known of them, shrunk towards a diagonal as
    Ledoit and Wolf do, and widened as the predictive (Student t) distribution asks for. Of fewer
    than five episodes it is `spread`.

    Parameters
    ----------
    means : ndarray of shape (n, d)
    covariances : ndarray of shape (n, d, d)
    spread : ndarray of shape (d,)
        Variances that say next to nothing.

    References
    ----------
    O. Ledoit and M. Wolf, "A well-conditioned estimator for large-dimensional covariance
    matrices", J. Multivariate Analysis 88 (2004) 365-411.
    """
    n, mean = len(means), means.mean(axis=0)
    if n < _FEWEST:
        return mean, np.diag(spread)
    unit = np.sqrt(np.maximum(means.var(axis=0), _LEAST * spread))
    shrunk, _ = ledoit_wolf((means - mean) / unit, assume_centered=True)
    widen = (n - 1) * (n + 1) / (n * (n - 3))
    covariance = widen * shrunk * np.outer(unit, unit) + covariances.mean(axis=0)
    return mean, (covariance + covariance.T) / 2
