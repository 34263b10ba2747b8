"""One interface to any regressor under a formulation: means and variances by member."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from sklearn.multioutput import MultiOutputRegressor
from sklearn.utils import get_tags
from sklearn.utils.validation import has_fit_parameter

from trajlearn.exceptions import NoUncertaintyError
from trajlearn.regressors._polynomial import polynomial_predictor
from trajlearn.regressors._prediction import mixture as mixture_of_members
from trajlearn.regressors.mlp import MLPEnsembleRegressor

Floats = NDArray[np.float64]
# rows (n, k), or each member's own (E, n, k), to means (E, n, d) and variances, if it gives any
Moments = Callable[[Floats], tuple[Floats, Floats | None]]
# the same from a learner that is known to give variances
FullMoments = Callable[[Floats], tuple[Floats, Floats]]
# rows (m, k) and the member that each is for (m,), to means and variances (m, d)
ByMember = Callable[[Floats, NDArray[np.intp]], tuple[Floats, Floats]]


def seeded(estimator: Any, rng: np.random.Generator) -> Any:
    """Clone with a seed from the parent wherever the estimator, or one inside it, has none."""
    copy = clone(estimator)
    for name, value in sorted(copy.get_params().items(), key=lambda item: item[0]):
        if name.rpartition("__")[2] == "random_state" and value is None:
            copy.set_params(**{name: int(rng.integers(2**31))})
    return copy


def fit_learner(
    estimator: BaseEstimator,
    rows: Floats,
    targets: Floats,
    *,
    weight: Floats | None,
    groups: NDArray[Any] | None,
) -> Any:
    """Fit on scaled rows and targets (n, d); single-output learners get one copy a target.

    Raises
    ------
    TypeError
        If weights are given and the learner does not take them.
    """
    if targets.shape[1] > 1 and not get_tags(estimator).target_tags.multi_output:
        estimator = MultiOutputRegressor(estimator)
    extra: dict[str, Any] = {}
    if weight is not None:
        if not has_fit_parameter(estimator, "sample_weight"):
            raise TypeError(
                f"sample_weight was given, but {type(estimator).__name__} does not take weights."
            )
        extra["sample_weight"] = weight
    if groups is not None and has_fit_parameter(estimator, "groups"):
        extra["groups"] = groups
    return estimator.fit(rows, targets[:, 0] if targets.shape[1] == 1 else targets, **extra)


def takes_weights(estimator: BaseEstimator) -> bool:
    """Whether a learner takes `sample_weight` (or would, one copy a target)."""
    return bool(has_fit_parameter(estimator, "sample_weight"))


def spread(values: Floats, magnitude: Floats, weight: Floats | None) -> Floats:
    """Standard deviation of each column (n, d): the unit in which it is learned.

    A constant has its own size for a unit, and zero a trillionth of `magnitude` (d,): a learner
    that is somewhat off must not move a state that never moved.
    """
    mean = np.average(values, axis=0, weights=weight)
    std = np.sqrt(np.average((values - mean) ** 2, axis=0, weights=weight))
    least = 1e-12 * np.maximum(magnitude, 1e-300)
    return np.where(std > least, std, np.maximum(np.abs(mean), least))


def moments_of(learner: Any, *, means_only: bool = False) -> Moments:
    """Function from scaled rows (n, k) to means (E, n, d) and variances (E, n, d) or None.

    `means_only` leaves the variances out, which of some learners take longer than the means.
    """
    if isinstance(learner, MLPEnsembleRegressor):
        predictor = learner.predictor(means_only=means_only)
        if means_only:
            return lambda rows: (predictor(rows)[..., : len(learner.target_mean_)], None)
        return lambda rows: learner.moments(predictor(rows))
    if isinstance(learner, MultiOutputRegressor):
        # it has no return_std itself, though its parts may
        return _side_by_side([moments_of(e, means_only=means_only) for e in learner.estimators_])
    lean = polynomial_predictor(learner)
    if lean is not None:
        return lambda rows: (lean(rows)[None], None)
    can = "return_std" in inspect.signature(learner.predict).parameters
    with_std = can and not means_only

    def moments(rows: Floats) -> tuple[Floats, Floats | None]:
        if not len(rows):
            raise ValueError("no rows to predict")
        if with_std:
            mean, std = learner.predict(rows, return_std=True)
            return _by_target(mean, len(rows)), _by_target(std, len(rows)) ** 2
        return _by_target(learner.predict(rows), len(rows)), None

    return moments


def _side_by_side(targets: list[Moments]) -> Moments:
    """Moments of several targets (E, n, 1) as those of one learner (E, n, d)."""

    def moments(rows: Floats) -> tuple[Floats, Floats | None]:
        means, variances = zip(*(target(rows) for target in targets))
        known = [variance for variance in variances if variance is not None]
        joined = np.concatenate(known, axis=-1) if len(known) == len(targets) else None
        return np.concatenate(means, axis=-1), joined

    return moments


def n_members_of(learner: Any) -> int:
    """E of a fitted learner: 1 of all but an ensemble of networks."""
    return len(learner.coefs_[0]) if isinstance(learner, MLPEnsembleRegressor) else 1


def own_moments_of(learner: Any) -> Moments:
    """Function from scaled rows of each member's own (E, n, k) to means and variances (E, n, d)."""
    if isinstance(learner, MLPEnsembleRegressor):
        predictor = learner.predictor()
        return lambda rows: learner.moments(predictor.own(rows))
    moments = moments_of(learner)
    return lambda rows: moments(rows[0])


def by_member(own: FullMoments, n_members: int) -> ByMember:
    """Evaluate each row by the one member that it is for.

    Parameters
    ----------
    own : callable
        From rows (E, n, k), each member's own, to means and variances (E, n, d).
    n_members : int
        E.
    """

    def moments(rows: Floats, member: NDArray[np.intp]) -> tuple[Floats, Floats]:
        order = np.argsort(member, kind="stable")
        counts = np.bincount(member, minlength=n_members)
        # place of each row in the queue of its member
        place = np.empty_like(order)
        place[order] = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        # the rest of a shorter queue is filled with a row that is possible
        queues = np.tile(rows[0], (n_members, counts.max(), 1))
        queues[member, place] = rows
        means, variances = own(queues)
        return means[member, place], variances[member, place]

    return moments


def _by_target(values: Any, n_rows: int) -> Floats:
    return np.asarray(values, dtype=np.float64).reshape(1, n_rows, -1)


def mixture(means: Floats, variances: Floats | None, learner: Any) -> tuple[Floats, Floats]:
    """Mean and variance of the mixture of all members (n, d).

    Raises
    ------
    ValueError
        If the learner gives no variance.
    """
    return mixture_of_members(means, required(variances, learner))


def required(variances: Floats | None, learner: Any) -> Floats:
    """The variances that a learner gives.

    Raises
    ------
    ValueError
        If it gives none.
    """
    if variances is None:
        raise NoUncertaintyError(
            f"{type(learner).__name__} gives no standard deviation. Use MLPEnsembleRegressor, "
            "GPRegressor or any regressor whose predict takes return_std."
        )
    return variances
