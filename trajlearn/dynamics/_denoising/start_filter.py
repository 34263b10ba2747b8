"""The state that a forecast starts from, given the measurements up to it and none after."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from trajlearn.dynamics._denoising.noise import NoiseModel
from trajlearn.dynamics._denoising.slopes import step_slopes
from trajlearn.dynamics._query import Query
from trajlearn.dynamics.propagation._algebra import product, transposed

__all__ = ["filtered_starts"]

Floats = NDArray[np.float64]

# A first measurement that starts as in training would give less often than this is from an
# episode that begins elsewhere (a window, another set-point).
_ELSEWHERE = 1e-4


def filtered_starts(model: Any, query: Query, noise: NoiseModel) -> tuple[Floats, Floats]:
    """Extended Kalman filter over ``states[:start + 1]`` and ``actions[:start]``.

    Parameters
    ----------
    model : RollingEstimator
        Fitted.
    query : Query
        Its states are those of the step, of which those measured are read.
    noise : NoiseModel

    Returns
    -------
    mean : ndarray of shape (n, d)
    covariance : ndarray of shape (n, d, d)
    """
    ds, step = query.ds, step_slopes(model)
    n = len(query)
    begin = ds.offsets[:-1]
    first = np.ones(n, dtype=bool)
    mean, covariance, surprise = _updated(*noise.start(first), ds.states[begin], noise)
    first = surprise < chi2.ppf(1 - _ELSEWHERE, len(noise.measurement))
    if not first.all():
        mean, covariance, _ = _updated(*noise.start(first), ds.states[begin], noise)
    process = np.diag(noise.process)
    for t in range(int(query.start.max())):
        on = np.flatnonzero(query.start > t)
        rows = model.relabeler_.rows(ds, on, begin[on] + t, begin[on] + t + 1)
        rows[:, model.layout_["state"]] = mean[on]
        after, slopes = step(rows)
        ahead = product(product(slopes, covariance[on]), transposed(slopes)) + process
        mean[on], covariance[on], _ = _updated(after, ahead, ds.states[begin[on] + t + 1], noise)
    return mean, covariance


def _updated(
    mean: Floats, covariance: Floats, measured: Floats, noise: NoiseModel
) -> tuple[Floats, Floats, Floats]:
    """After measurements (n, m), one number after the other; and how improbable they were (n,)."""
    surprise = np.zeros(len(mean))
    for i, variance in enumerate(noise.measurement):
        total = covariance[:, i, i] + variance
        error = measured[:, i] - mean[:, i]
        gain = covariance[:, :, i] / total[:, None]
        mean = mean + gain * error[:, None]
        covariance = covariance - gain[:, :, None] * covariance[:, None, i, :]
        surprise += error**2 / total
    return mean, covariance, surprise
