"""Many episodes of unequal length, as one immutable container that scikit-learn can split."""

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories._arrays import check_names, pack_arrays, same, unique_ids
from trajlearn.trajectories._columns import VECTOR_FIELDS, Columns, pack
from trajlearn.trajectories._fields import Fields
from trajlearn.trajectories.trajectory import Trajectory

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["TrajectoryDataset"]


class TrajectoryDataset(Fields):
    """Episodes of unequal length; the sample of scikit-learn is the episode.

    Every field is one contiguous array plus offsets, so that slicing 2,000 episodes, sending
    them to a worker process or drawing rows from them costs no Python loop. ``len(ds)`` is the
    number of episodes, ``ds[i]`` a `Trajectory`, and ``ds[slice | mask | indices]`` a dataset,
    which is all that `train_test_split`, `KFold`, `GridSearchCV` and their kin ask for.

    Parameters
    ----------
    episodes : sequence of Trajectory
    state_names, action_names, param_names, reference_names : sequence of str, optional
        Names of the columns; default ``s0, s1, ...``, ``a0, ...``, ``theta0, ...``, ``ref0, ...``.

    Raises
    ------
    InvalidEpisodeError
        Where the episodes do not fit together; the message names the episode.

    See Also
    --------
    TrajectoryDataset.from_arrays, TrajectoryDataset.from_frame, TrajectoryDataset.from_gymnasium

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> ds = TrajectoryDataset.from_arrays(
    ...     [rng.normal(size=(5, 2)), rng.normal(size=(9, 2))], params=[[0.1], [0.2]], dt=0.02
    ... )
    >>> ds
    TrajectoryDataset(n=2, steps=4..8, d_s=2, p=1)
    >>> ds[1]
    Trajectory(steps=8, d_s=2, p=1, duration=0.16)
    >>> ds[[True, False]].lengths
    array([4])
    """

    def __init__(
        self,
        episodes: Sequence[Trajectory],
        *,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        param_names: Sequence[str] | None = None,
        reference_names: Sequence[str] | None = None,
    ) -> None:
        for item in episodes:
            if not isinstance(item, Trajectory):
                raise InvalidEpisodeError(
                    f"expected Trajectory objects, got {type(item).__name__}; for plain arrays "
                    "use TrajectoryDataset.from_arrays, for a table from_frame."
                )
        ids = unique_ids([episode.id for episode in episodes])
        self._columns = pack([episode.to_dict() for episode in episodes], ids)
        self._names = check_names(
            self._columns, state_names, action_names, param_names, reference_names
        )

    @classmethod
    def _of(cls, columns: Columns, names: Mapping[str, tuple[str, ...]]) -> "TrajectoryDataset":
        dataset = cls.__new__(cls)
        dataset._columns, dataset._names = columns, dict(names)
        return dataset

    # -- constructors ---------------------------------------------------------------------

    @classmethod
    def from_list(
        cls, episodes: Iterable[Trajectory], **names: Sequence[str]
    ) -> "TrajectoryDataset":
        """Dataset of `Trajectory` objects; `names` as in the constructor."""
        return cls(list(episodes), **names)

    @classmethod
    def from_arrays(
        cls,
        states: ArrayLike | Sequence[ArrayLike],
        *,
        actions: ArrayLike | Sequence[ArrayLike] | None = None,
        rewards: ArrayLike | Sequence[ArrayLike] | None = None,
        params: ArrayLike | Sequence[ArrayLike] | None = None,
        references: ArrayLike | Sequence[ArrayLike] | None = None,
        times: ArrayLike | Sequence[ArrayLike] | None = None,
        dt: float = 1.0,
        time_origin: ArrayLike | None = None,
        context: Mapping[str, Sequence[Any]] | None = None,
        group: Sequence[Hashable] | None = None,
        terminated: ArrayLike | None = None,
        ids: Sequence[Hashable] | None = None,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
        param_names: Sequence[str] | None = None,
        reference_names: Sequence[str] | None = None,
    ) -> "TrajectoryDataset":
        """Dataset from arrays, one item an episode.

        Parameters
        ----------
        states : array-like of shape (n, T + 1, d_s), or n arrays of shape (T_i + 1, d_s)
        actions : (n, T, d_a) or n arrays of shape (T_i, d_a), optional
        rewards : (n, T) or n arrays of shape (T_i,), optional
        params : (n, p), or n arrays of shape (p,) or (T_i, p), optional
        references : (n, T + 1, d_r) or n arrays of shape (T_i + 1, d_r), optional
        times : (n, T + 1) or n arrays of shape (T_i + 1,), optional
            Default: ``t * dt``.
        dt : float, default=1.0
        time_origin : array-like of shape (n,), optional
        context : mapping from name to n values, optional
        group, ids : sequence of n labels, optional
        terminated : array-like of shape (n,) of bool, optional
        state_names, action_names, param_names, reference_names : sequence of str, optional

        Returns
        -------
        TrajectoryDataset

        Raises
        ------
        InvalidEpisodeError
            Wrong shapes, non-finite values, unsorted times, too short episodes.
        """
        given = {
            "actions": actions,
            "rewards": rewards,
            "params": params,
            "references": references,
            "times": times,
            "time_origin": time_origin,
            "group": group,
            "terminated": terminated,
        }
        columns = pack_arrays(states, given, dict(context or {}), ids, dt)
        return cls._of(
            columns, check_names(columns, state_names, action_names, param_names, reference_names)
        )

    @classmethod
    def from_frame(cls, frame: "pd.DataFrame", **columns: Any) -> "TrajectoryDataset":
        """Dataset from a long table, one row a step; see `trajlearn.trajectories.from_frame`."""
        from trajlearn.trajectories.frames import from_frame

        return from_frame(frame, **columns)

    @classmethod
    def from_gymnasium(cls, env: Any, policy: Any, **settings: Any) -> "TrajectoryDataset":
        """Run a Gymnasium environment; see `trajlearn.trajectories.from_gymnasium`."""
        from trajlearn.trajectories.sources import from_gymnasium

        return from_gymnasium(env, policy, **settings)

    @classmethod
    def from_minari(cls, dataset: Any, **settings: Any) -> "TrajectoryDataset":
        """Episodes of a Minari data set; see `trajlearn.trajectories.from_minari`."""
        from trajlearn.trajectories.sources import from_minari

        return from_minari(dataset, **settings)

    @classmethod
    def load(cls, path: str | Path) -> "TrajectoryDataset":
        """Read a file that `save` wrote (``.npz`` or ``.parquet``); nothing in it is executed.

        Raises
        ------
        UnknownFileError
            If the file is truncated, changed, or of another kind.
        """
        from trajlearn.trajectories.files import load_dataset

        return load_dataset(path)

    # -- the container --------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int]:
        """``(n,)``: scikit-learn takes an episode as the sample."""
        return (len(self),)

    def __iter__(self) -> Iterator[Trajectory]:
        return (Trajectory._of(self._columns, i) for i in range(len(self)))

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, tuple):
            # scikit-learn indexes samples with (indices, ...)
            if len(key) != 2 or key[1] is not Ellipsis:
                raise IndexError("index episodes only: ds[i], ds[indices], ds[mask] or ds[a:b].")
            key = key[0]
        if isinstance(key, (int, np.integer)) and not isinstance(key, bool):
            i = int(key) + (len(self) if key < 0 else 0)
            if not 0 <= i < len(self):
                raise IndexError(f"episode {key} of a dataset of {len(self)}.")
            return Trajectory._of(self._columns, i)
        if not isinstance(key, slice):
            key = np.asarray(key)
            key = key.astype(np.intp) if not key.size else key
        index = np.arange(len(self))[key]
        if index.ndim != 1 or not len(index):
            raise IndexError("the index selects no episode; a dataset has at least one.")
        return TrajectoryDataset._of(self._columns.take(index), self._names)

    def __array__(self, *args: Any, **kwargs: Any) -> NDArray[Any]:
        raise TypeError(
            "a TrajectoryDataset is ragged and cannot become one array. A row transformer such as "
            "StandardScaler cannot stand before a dynamics estimator on episodes: the estimators "
            "scale by block themselves (scaler=). For rows, use a relabeler: "
            "SubtrajectoryRelabeler().fit_resample(ds); for a table, ds.to_frame()."
        )

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._columns.freeze()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TrajectoryDataset):
            return NotImplemented
        mine, theirs = vars(self._columns), vars(other._columns)
        return self._names == other._names and all(same(mine[name], theirs[name]) for name in mine)

    __hash__ = None  # type: ignore[assignment]

    # -- new datasets ---------------------------------------------------------------------

    def truncate(self, max_steps: int) -> "TrajectoryDataset":
        """At most the first `max_steps` steps of each episode.

        An episode cut short is no longer `terminated`.
        """
        from trajlearn.trajectories import edits

        return edits.truncate(self, max_steps)

    def window(self, length: int, *, stride: int | None = None) -> "TrajectoryDataset":
        """Windows of `length` steps, every `stride` steps (default: one after the other)."""
        from trajlearn.trajectories import edits

        return edits.window(self, length, stride=stride)

    def resample(self, dt: float) -> "TrajectoryDataset":
        """Episodes on the uniform grid of step `dt`: states linear, actions and theta held."""
        from trajlearn.trajectories import edits

        return edits.resample(self, dt)

    def decimate(self, k: int) -> "TrajectoryDataset":
        """As if logged `k` times slower: every k-th state and the action applied there."""
        from trajlearn.trajectories import edits

        return edits.decimate(self, k)

    def select_states(self, names: Sequence[str]) -> "TrajectoryDataset":
        """Keep the named state columns, in that order."""
        from trajlearn.trajectories import edits

        return edits.select_states(self, names)

    def assign(self, **fields: Any) -> "TrajectoryDataset":
        """The same episodes with some fields replaced, such as ``params=`` or ``references=``."""
        from trajlearn.trajectories import edits

        return edits.assign(self, **fields)

    def add_noise(
        self,
        fraction: float,
        *,
        of: Literal["std", "range"] = "std",
        random_state: Any = None,
    ) -> "TrajectoryDataset":
        """Add Gaussian measurement noise to the states, a fraction of each state's std or range."""
        from trajlearn.trajectories import edits

        return edits.add_noise(self, fraction, of=of, random_state=random_state)

    def concatenate(self, *others: "TrajectoryDataset") -> "TrajectoryDataset":
        """These episodes followed by those of `others`, which need the same fields."""
        from trajlearn.trajectories import edits

        return edits.concatenate(self, *others)

    # -- out ------------------------------------------------------------------------------

    def to_frame(self) -> "pd.DataFrame":
        """Long table, one row a state; see `trajlearn.trajectories.to_frame`."""
        from trajlearn.trajectories.frames import to_frame

        return to_frame(self)

    def save(self, path: str | Path) -> None:
        """Write a ``.npz`` (no pickle inside) or ``.parquet`` file, whole or not at all."""
        from trajlearn.trajectories.files import save_dataset

        save_dataset(self, path)

    def describe(self) -> "pd.DataFrame":
        """One row a column of every field: count, mean, std, min, max."""
        from trajlearn.trajectories.frames import describe

        return describe(self)

    def __repr__(self) -> str:
        low, high = self.lengths.min(), self.lengths.max()
        parts = [f"n={len(self)}", f"steps={low}" if low == high else f"steps={low}..{high}"]
        for field, label in zip(VECTOR_FIELDS, ("d_s", "d_a", "p", "d_r")):
            if self._names[field]:
                parts.append(f"{label}={len(self._names[field])}")
        if self.observed is not None:
            parts.append("observed")
        if self.hindsight:
            parts.append("hindsight")
        if self.params_vary:
            parts.append("params vary")
        if self.terminated.any():
            parts.append(f"terminated={int(self.terminated.sum())}")
        if self.group is not None:
            parts.append(f"groups={len(np.unique(self.group))}")
        return f"TrajectoryDataset({', '.join(parts)})"
