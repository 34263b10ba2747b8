"""Splits of episodes that were recorded one after another."""

from collections.abc import Iterator, Sequence
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.model_selection import BaseCrossValidator

from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories import TrajectoryDataset, as_dataset, is_episodes

__all__ = ["BlockKFold"]

Ints = NDArray[np.intp]


class BlockKFold(BaseCrossValidator):
    """K folds that are blocks of the order of recording, with groups kept whole.

    Where gains are tuned one after another, neighbours in time share their gains, the battery
    and the wear of the machine. Folds drawn at random then have a near twin of most test episodes
    among the training episodes, and a model seems to understand gains that it only remembers.
    Here a fold is a stretch of the recording, and its model has to extrapolate to it.

    The order is that of the episodes in the data: sort them by time first. Groups (experiments)
    come in the order in which they first appear, and blocks have the same number of groups, or
    one more.

    Parameters
    ----------
    n_splits : int, default=5
        Blocks; at least 2.
    gap : int, default=0
        Groups next to the test block, on either side, that are left out of training.
    within : str or sequence of str, optional
        Names in ``ds.context``, such as ``("kind", "motors")``. Blocks are cut inside each
        combination of their values, so that every fold trains and tests on each of them. A group
        that has several combinations counts in that of its first episode.

    See Also
    --------
    sklearn.model_selection.GroupKFold : groups at random, for episodes without an order.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays(np.zeros((8, 3, 1)), group=list("aabbccdd"))
    >>> for train, test in BlockKFold(2).split(ds):
    ...     print(train, test)
    [4 5 6 7] [0 1 2 3]
    [0 1 2 3] [4 5 6 7]
    >>> [train.tolist() for train, _ in BlockKFold(4, gap=1).split(ds)]
    [[4, 5, 6, 7], [6, 7], [0, 1], [0, 1, 2, 3]]
    """

    # metadata routing: groups are passed on without being asked for
    __metadata_request__split = {"groups": True}  # noqa: RUF012

    def __init__(
        self, n_splits: int = 5, *, gap: int = 0, within: str | Sequence[str] | None = None
    ) -> None:
        self.n_splits = n_splits
        self.gap = gap
        self.within = within

    def get_n_splits(self, X: Any = None, y: Any = None, groups: Any = None) -> int:
        """Number of folds; the arguments are ignored."""
        return self.n_splits

    def split(
        self, X: Any, y: Any = None, groups: ArrayLike | None = None
    ) -> Iterator[tuple[Ints, Ints]]:
        """Training and test episodes of each fold, in the order of recording.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory or array-like of shape (n, ...)
            Episodes are needed for `within` only.
        y : object
            Ignored.
        groups : array-like of shape (n,), optional
            Labels of episodes that must not be parted. Default: ``X.group`` where there is one,
            else each episode alone.

        Yields
        ------
        train, test : ndarray
            Increasing indices; each episode is in one test set.

        Raises
        ------
        ValueError
            If a parameter is out of range, there are fewer groups than splits (also inside a
            stratum), `groups` has the wrong length, or the gap leaves nothing to train on.
        MissingFieldError
            If `X` has no such context.
        """
        self._check_parameters()
        X = as_dataset(X) if is_episodes(X) else X
        group, first = _numbered(X, groups)
        strata = self._strata(X, first, np.bincount(group))
        for fold in range(self.n_splits):
            tested, trained = np.zeros(len(first), dtype=bool), np.ones(len(first), dtype=bool)
            for members, edges in strata:
                low, high = edges[fold], edges[fold + 1]
                tested[members[low:high]] = True
                trained[members[max(low - self.gap, 0) : high + self.gap]] = False
            if not trained.any():
                raise ValueError(
                    f"gap = {self.gap} leaves no group to train on in fold {fold}; take a smaller "
                    "gap or more splits."
                )
            yield np.flatnonzero(trained[group]), np.flatnonzero(tested[group])

    def _check_parameters(self) -> None:
        for name, least in (("n_splits", 2), ("gap", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
                raise ValueError(f"{name} = {value!r} must be a whole number, at least {least}.")

    def _strata(self, X: Any, first: Ints, sizes: Ints) -> list[tuple[Ints, Ints]]:
        """Groups of each stratum in order, and the n_splits + 1 edges of its blocks."""
        order = np.argsort(first)
        keys = self._keys(X)
        strata: dict[tuple[Any, ...], list[int]] = {}
        for group in order:
            strata.setdefault(keys[first[group]] if keys else (), []).append(group)
        load = np.zeros(self.n_splits)  # episodes of each fold so far
        blocks = []
        for key, groups in strata.items():
            if len(groups) < self.n_splits:
                where = f" where {self._said(key)}" if key else ""
                raise ValueError(
                    f"n_splits = {self.n_splits}, but there are only {len(groups)} groups{where}: "
                    "take fewer splits" + (", or leave such episodes out." if key else ".")
                )
            members = np.array(groups)
            length = np.full(self.n_splits, len(members) // self.n_splits)
            # those left over go to the folds that are smallest so far
            length[np.argsort(load, kind="stable")[: len(members) % self.n_splits]] += 1
            edges = np.concatenate([[0], np.cumsum(length)])
            load += np.add.reduceat(sizes[members], edges[:-1])
            blocks.append((members, edges))
        return blocks

    def _keys(self, X: Any) -> list[tuple[Any, ...]]:
        """Stratum of each episode; none at all without `within`."""
        names = self._names()
        if not names:
            return []
        if not isinstance(X, TrajectoryDataset):
            raise MissingFieldError(
                f"within = {self.within!r} names context of a TrajectoryDataset, but X is "
                f"{type(X).__name__}. Give the episodes, or leave within out."
            )
        missing = [name for name in names if name not in X.context]
        if missing:
            raise MissingFieldError(
                f"within names {missing}, but the context of the episodes is {sorted(X.context)}."
            )
        return list(zip(*(X.context[name].tolist() for name in names)))

    def _names(self) -> tuple[str, ...]:
        return (self.within,) if isinstance(self.within, str) else tuple(self.within or ())

    def _said(self, key: tuple[Any, ...]) -> str:
        return ", ".join(f"{name} = {value!r}" for name, value in zip(self._names(), key))


def _numbered(X: Any, groups: ArrayLike | None) -> tuple[Ints, Ints]:
    """Number of the group of each episode, and the first episode of each group."""
    n = len(X)
    if groups is None and isinstance(X, TrajectoryDataset):
        groups = X.group
    labels = np.arange(n) if groups is None else np.asarray(groups)
    if labels.shape != (n,):
        raise ValueError(f"groups has shape {labels.shape}: give one label an episode, ({n},).")
    _, first, group = np.unique(labels, return_index=True, return_inverse=True)
    return group, first
