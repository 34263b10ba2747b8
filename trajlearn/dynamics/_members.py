"""One member of a fitted ensemble as a model of its own, for Thompson sampling."""

from copy import copy
from typing import Any

from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline

from trajlearn.dynamics._learner import n_members_of
from trajlearn.dynamics._meta import ForecasterAround
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["inside", "member_of", "n_members", "unwrapped"]

# what a fitted ensemble has of each member: lists of arrays (E, ...), and one array (2, E, ...)
_BY_LAYER = ("coefs_", "intercepts_", "variance_coefs_", "variance_intercepts_")


def unwrapped(model: Any) -> Any:
    """What predicts, inside a search over settings, a pipeline, a calibration or a distillation."""
    while (inner := inside(model)) is not None:
        model = inner
    return model


def n_members(model: Any) -> int:
    """E of a fitted dynamics estimator or direct reward model; 1 of all but ensembles."""
    return n_members_of(getattr(unwrapped(model), "estimator_", None))


def member_of(model: Any, i: int) -> Any:
    """Copy of a fitted dynamics estimator, or direct reward model, with one member of its ensemble.

    Arrays are shared with `model`, which stays as it is. A `CalibratedForecaster` gives a
    member of the model inside, as its calibration is of all members together, and a
    `DistilledForecaster` one of its student.

    Parameters
    ----------
    model : estimator
        Fitted; a `Pipeline`, a `FrozenEstimator` or a search over settings may be around it.
    i : int
        From 0 to E - 1; a model without an ensemble has member 0 only, which is itself.

    Returns
    -------
    estimator

    Raises
    ------
    ValueError
        If there is no such member.
    """
    size = n_members(model)
    if not 0 <= i < size:
        raise ValueError(f"there is no member {i}: the model has {size}, counted from 0.")
    return _with_member(model, i)


def inside(model: Any) -> Any:
    """The model that one leaves its predictions to, or None."""
    if isinstance(model, Pipeline):
        return model[-1]
    if isinstance(model, FrozenEstimator):
        return model.estimator
    if isinstance(model, ForecasterAround):
        return model._forecaster
    return getattr(model, "best_estimator_", None)


def _with_member(model: Any, i: int) -> Any:
    inner = inside(model)
    if inner is not None:
        one = _with_member(inner, i)
        if not isinstance(model, Pipeline):
            return one
        found = copy(model)
        found.steps = [*model.steps[:-1], (model.steps[-1][0], one)]
        return found
    found = copy(model)
    if isinstance(learner := getattr(model, "estimator_", None), MLPEnsembleRegressor):
        found.estimator_ = _member(learner, i)
    return found


def _member(ensemble: MLPEnsembleRegressor, i: int) -> MLPEnsembleRegressor:
    one = copy(ensemble)
    one.n_members = 1
    for name in _BY_LAYER:
        if hasattr(ensemble, name):
            setattr(one, name, [array[i : i + 1] for array in getattr(ensemble, name)])
    one.residual_std_ = ensemble.residual_std_[i : i + 1]
    one.logvar_bounds_ = ensemble.logvar_bounds_[:, i : i + 1]
    return one
