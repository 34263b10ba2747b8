"""A learned step and its slopes in the state, for many rows at once."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from torch import Tensor
from torch.nn.functional import pad

from trajlearn.dynamics.propagation._steps import DIFFERENCE
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors._device import find_device
from trajlearn.regressors._network import ACTIVATIONS
from trajlearn.regressors._prediction import BLOCK, LANES, mean_of_members
from trajlearn.regressors._threads import threads_for
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["StepSlopes", "step_slopes"]

Floats = NDArray[np.float64]
# raw rows (n, n_features) -> next states (n, d), and their slopes in the states (n, d, d)
StepSlopes = Callable[[Floats], tuple[Floats, Floats]]
# scaled rows (n, k) -> outputs (n, d), and their slopes (n, d, k)
_LearnerSlopes = Callable[[Floats], tuple[Floats, Floats]]


def step_slopes(model: Any) -> StepSlopes:
    """The mean step of a fitted one-step model with its slopes.

    They are exact for networks and for linear models of polynomial features, behind scalers that
    are linear in each column, and central differences for anything else.

    Parameters
    ----------
    model : RollingEstimator
        Fitted; actions and all else but the state are held.

    Returns
    -------
    callable
    """
    own = model.layout_["state"]
    affine = getattr(model.scaler_, "affine_", None)
    learner = _slopes_of(model.estimator_)
    if learner is None or affine is None or not isinstance(model.scaler_, BlockScaler):
        return _by_differences(model)
    columns, scale, _ = affine
    # a column of the scaled row is one of the raw row; which, and times what, for the states
    into = np.zeros((len(columns), own.stop - own.start))
    of_state = np.flatnonzero((columns >= own.start) & (columns < own.stop))
    into[of_state, columns[of_state] - own.start] = scale[of_state]
    unit = model.target_scale_[:, None]

    def step(rows: Floats) -> tuple[Floats, Floats]:
        outputs, slopes = learner(model.scaler_.scaled(rows))
        after, _ = model._restore(rows, outputs, outputs)
        slopes = slopes @ into * unit
        if model.target == "change":
            slopes += np.eye(slopes.shape[-1])
        return after, slopes

    return step


def _by_differences(model: Any) -> StepSlopes:
    own = model.layout_["state"]
    moments = model._moments(means_only=True)
    width = np.ptp(model.rolled_range_, axis=0)
    reach = DIFFERENCE * np.where(width > 0, width, 1.0)

    def step(rows: Floats) -> tuple[Floats, Floats]:
        n, d = len(rows), len(reach)
        moved = np.tile(rows, (1 + 2 * d, 1, 1))
        for j in range(d):
            moved[1 + j, :, own.start + j] += reach[j]
            moved[1 + d + j, :, own.start + j] -= reach[j]
        means = mean_of_members(moments(moved.reshape(-1, rows.shape[1]))[0])
        means = means.reshape(1 + 2 * d, n, d)
        ahead, behind = means[1 : 1 + d], means[1 + d :]
        slopes = (ahead - behind) / (2 * reach[:, None, None])
        return means[0], np.ascontiguousarray(np.moveaxis(slopes, 0, -1))

    return step


def _slopes_of(learner: Any) -> _LearnerSlopes | None:
    """Exact slopes of a learner, or None."""
    if isinstance(learner, MLPEnsembleRegressor):
        return lambda rows: _of_network(learner, rows)
    if isinstance(learner, Pipeline):
        return _of_polynomial(learner)
    return None


def _of_network(learner: MLPEnsembleRegressor, rows: Floats) -> tuple[Floats, Floats]:
    """Mean of the members and its slopes, back through the layers.

    In blocks of one size and of whole vectors, for the same bits whatever other rows there are.
    """
    device, d, k = find_device(learner.device), len(learner.target_mean_), rows.shape[1]
    forward, back = ACTIVATIONS[learner.activation]
    x = torch.zeros((len(rows) + -len(rows) % BLOCK, k + -k % LANES), device=device)
    x[: len(rows), :k] = torch.as_tensor(rows)
    n_members, widths = len(learner.coefs_[0]), (len(x), d + -d % LANES)
    outputs, slopes = x.new_zeros(widths), x.new_zeros((d, *x.shape))
    with threads_for(0.0), torch.inference_mode():
        for e in range(n_members):
            weights = [_padded(w[e], device) for w in learner.coefs_]
            biases = [_padded(b[e], device, rows=False) for b in learner.intercepts_]
            # a probabilistic network gives log variances behind the means
            last, shift = weights[-1][:, : widths[1]], biases[-1][:, : widths[1]]
            for at in range(0, len(x), BLOCK):
                part = slice(at, at + BLOCK)
                a, layers = x[part], []
                for weight, bias in zip(weights[:-1], biases[:-1]):
                    z = torch.addmm(bias, a, weight)
                    a = torch.empty_like(z)
                    forward(z, a)
                    layers.append((z, a))
                outputs[part] += torch.addmm(shift, a, last)
                for i in range(d):
                    grad = last[:, i].expand(BLOCK, -1).contiguous()
                    for weight, (z, a) in zip(weights[-2::-1], layers[::-1]):
                        back(grad, z, a)
                        grad = grad @ weight.T
                    slopes[i, part] += grad
    scale = learner.target_scale_
    mean = outputs[: len(rows), :d].cpu().numpy() / n_members * scale + learner.target_mean_
    steep = slopes[:, : len(rows), :k].cpu().numpy().transpose(1, 0, 2)
    return mean, steep / n_members * scale[:, None]


def _padded(values: NDArray[Any], device: torch.device, *, rows: bool = True) -> Tensor:
    above = -values.shape[0] % LANES if rows else 0
    return pad(torch.as_tensor(values, device=device), (0, -values.shape[1] % LANES, 0, above))


def _of_polynomial(learner: Pipeline) -> _LearnerSlopes | None:
    """Slopes of a linear model of monomials: each has a multiple of a lower one for a slope."""
    if len(learner.steps) == 1:
        return None
    features, *between, linear = (step for _, step in learner.steps)
    scaled = len(between) == 1 and isinstance(between[0], StandardScaler)
    if not isinstance(features, PolynomialFeatures) or (between and not scaled):
        return None
    if not hasattr(linear, "coef_") or not hasattr(linear, "intercept_"):
        return None
    coef = np.atleast_2d(linear.coef_)
    shift = np.broadcast_to(np.asarray(linear.intercept_, dtype=np.float64), len(coef))
    if scaled:
        unit = np.ones(coef.shape[1]) if between[0].scale_ is None else between[0].scale_
        coef = coef / unit
        if between[0].with_mean:
            shift = shift - coef @ between[0].mean_
    powers = features.powers_
    place = {tuple(row): i for i, row in enumerate(powers)}
    constant = np.zeros((len(coef), powers.shape[1]))
    of_features = np.zeros((len(powers), len(coef), powers.shape[1]))
    for i, row in enumerate(powers):
        for j in np.flatnonzero(row):
            lower = row.copy()
            lower[j] -= 1
            if not lower.any():
                constant[:, j] += row[j] * coef[:, i]
            elif tuple(lower) in place:
                of_features[place[tuple(lower)], :, j] += row[j] * coef[:, i]
            else:
                return None
    flat = of_features.reshape(len(powers), -1)

    def slopes(rows: Floats) -> tuple[Floats, Floats]:
        monomials = features.transform(rows)
        steep = (monomials @ flat).reshape(len(rows), *constant.shape)
        return monomials @ coef.T + shift, steep + constant

    # others have coefficients, too, of centred columns or behind a link
    probe = np.random.default_rng(0).normal(size=(5, powers.shape[1]))
    given = learner.predict(probe).reshape(len(probe), -1)
    same = np.allclose(slopes(probe)[0], given, atol=1e-6 * np.abs(given).max())
    return slopes if same else None
