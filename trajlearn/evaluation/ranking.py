"""How well predicted scores rank episodes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata
from sklearn.utils import check_random_state

from trajlearn.evaluation._matching import matched_scores

__all__ = ["rank_correlation"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def rank_correlation(
    predicted: ArrayLike,
    true: ArrayLike,
    *,
    folds: ArrayLike | None = None,
    groups: ArrayLike | None = None,
    n_bootstrap: int = 1000,
    level: float = 0.9,
    random_state: int | np.random.RandomState | None = None,
) -> dict[str, float]:
    """Spearman correlation of predicted and true scores, pooled and inside folds.

    Pooling out-of-fold predictions mixes models: each fold has its own bias, and a model that
    predicts the mean of its training episodes is *anti*-correlated with the truth, because a fold
    of high scores leaves a low mean to train on. Ranks inside a fold are free of that, but few.
    Neither number is safe alone, so both are returned.

    Parameters
    ----------
    predicted : array-like of shape (n,)
        One score an episode, such as its tracking error or reward. Infinite where the forecast
        diverged: a reward of -inf or a cost of +inf ranks last.
    true : array-like of shape (n,)
        Finite.
    folds : array-like of shape (n,), optional
        Which fold predicted each episode. Without it there is no correlation inside folds.
    groups : array-like of shape (n,), optional
        Labels that the bootstrap redraws whole, such as ``ds.group``: repeats of one experiment
        are no independent evidence. Default: each episode alone.
    n_bootstrap : int, default=1000
        Draws of groups with replacement; 0 leaves the intervals out (NaN).
    level : float, default=0.9
        Probability of the (percentile) intervals.
    random_state : int, RandomState or None, default=None

    Returns
    -------
    dict
        ``pooled`` over all episodes and ``per_fold``, the mean over folds, each followed by
        ``..._lower`` and ``..._upper``; ``n_episodes``, ``n_diverged`` (infinite predictions),
        ``n_folds`` that `per_fold` averages and ``n_folds_undefined``, those left out of it.
        Ties share their mean rank. Where all predictions or all true scores are equal, or there
        is one episode only, the correlation is undefined: NaN.

    Raises
    ------
    ValueError
        If the shapes are not the same (n,), a prediction is NaN or a true score not finite, or
        `level` or `n_bootstrap` is out of range.

    Examples
    --------
    Inside each fold the order is right, over both it is not:

    >>> found = rank_correlation(
    ...     [5.0, 6.0, 7.0, 1.0, 2.0, 3.0], [1, 2, 3, 4, 5, 6], folds=[0, 0, 0, 1, 1, 1],
    ...     random_state=0,
    ... )
    >>> round(found["pooled"], 2), round(found["per_fold"], 2), found["n_folds"]
    (-0.54, 1.0, 2)
    """
    guess, target = matched_scores(predicted, true, "score")
    if not 0 < level < 1:
        raise ValueError(f"level = {level} must lie between 0 and 1.")
    if n_bootstrap < 0:
        raise ValueError(f"n_bootstrap = {n_bootstrap} must not be negative.")
    n = len(guess)
    fold = np.full(n, -1) if folds is None else _numbered(folds, "folds", n)
    group = np.arange(n) if groups is None else _numbered(groups, "groups", n)

    pooled, inside = _correlations(guess, target, fold)
    rng = check_random_state(random_state)
    rows = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    drawn = np.full((n_bootstrap, 2), np.nan)
    for values in drawn:
        index = np.concatenate([rows[g] for g in rng.randint(len(rows), size=len(rows))])
        again, again_inside = _correlations(guess[index], target[index], fold[index])
        values[:] = again, _mean(again_inside)
    result: dict[str, float] = {}
    for name, value, draws in zip(("pooled", "per_fold"), (pooled, _mean(inside)), drawn.T):
        result[name] = value
        result[f"{name}_lower"], result[f"{name}_upper"] = _interval(draws, level)
    return result | {
        "n_episodes": n,
        "n_diverged": int(np.isinf(guess).sum()),
        "n_folds": int((~np.isnan(inside)).sum()),
        "n_folds_undefined": int(np.isnan(inside).sum()),
    }


def _numbered(labels: ArrayLike, name: str, n: int) -> Ints:
    values = np.asarray(labels)
    if values.shape != (n,):
        raise ValueError(f"{name} has shape {values.shape}: give one label an episode, ({n},).")
    return np.unique(values, return_inverse=True)[1]


def _correlations(predicted: Floats, true: Floats, fold: Ints) -> tuple[float, Floats]:
    """Over all episodes, and inside each fold; a fold of -1 is none."""
    inside = [
        _spearman(predicted[fold == label], true[fold == label])
        for label in np.unique(fold)
        if label >= 0
    ]
    return _spearman(predicted, true), np.array(inside)


def _spearman(predicted: Floats, true: Floats) -> float:
    """Correlation of the ranks; scipy's `spearmanr` spends most of its time on a p-value."""
    # ranks are finite where scores are not
    x, y = rankdata([predicted, true], axis=1) - (len(true) + 1) / 2
    spread = np.sqrt((x @ x) * (y @ y))
    return float(x @ y / spread) if spread > 0 else float("nan")


def _mean(values: Floats) -> float:
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else float("nan")


def _interval(draws: Floats, level: float) -> tuple[float, float]:
    """Percentiles of the draws in which the correlation is defined."""
    defined = draws[~np.isnan(draws)]
    if not len(defined):
        return float("nan"), float("nan")
    lower, upper = np.quantile(defined, [(1 - level) / 2, (1 + level) / 2])
    return float(lower), float(upper)
