"""What the relabelers share: imbalanced-learn's ``fit_resample`` protocol, blocks and layout."""

import warnings
from abc import abstractmethod
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.utils import Tags, check_random_state
from sklearn.utils.validation import check_is_fitted

from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories._layout import Layout
from trajlearn.trajectories._signals import interpolate
from trajlearn.trajectories.coerce import as_dataset
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.times import time_differences

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def generator(random_state: Any) -> np.random.Generator:
    """Numpy generator from whatever scikit-learn takes as `random_state`."""
    if isinstance(random_state, np.random.Generator):
        return random_state
    if isinstance(random_state, (int, np.integer)):
        return np.random.default_rng(int(random_state))
    return np.random.default_rng(check_random_state(random_state).randint(2**31, size=4))


class Relabeler(BaseEstimator):
    """Base of the relabelers: blocks, layout, context categories."""

    _blocks: ClassVar[tuple[str, ...]]
    _required: ClassVar[tuple[str, ...]]
    inputs: Any
    n_knots: int = 0

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.requires_fit = False
        return tags

    def fit(self, X: Any, y: None = None) -> Self:
        """Learn the layout of a row and the categories of the context.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Ignored.

        Returns
        -------
        self
        """
        self._validate_params()
        ds = as_dataset(X)
        chosen = self._chosen(ds)
        unknown = [block for block in chosen if block not in self._blocks]
        missing = [block for block in self._required if block not in chosen]
        if unknown or missing:
            raise ValueError(
                f"inputs={self.inputs!r}: unknown blocks {unknown}, missing blocks {missing}; "
                f"choose from {list(self._blocks)}."
            )
        self.context_categories_ = (
            {key: np.unique(values) for key, values in ds.context.items()}
            if "context" in chosen
            else {}
        )
        names = {block: self._columns(ds, block) for block in self._blocks if block in chosen}
        self.layout_ = Layout(names)
        return self

    def _chosen(self, ds: TrajectoryDataset) -> tuple[str, ...]:
        """Blocks named by `inputs`, or every block that the episodes have."""
        if self.inputs is None:
            known = np.isfinite(ds.time_origin)
            if "phase" in self._blocks and known.any() and not known.all():
                warnings.warn(
                    f"{int((~known).sum())} of {len(ds)} episodes have no time_origin, so the "
                    "phase is no input. Leave them out, or align them; or choose inputs= without "
                    "'phase' to say that this is meant.",
                    stacklevel=4,
                )
            return tuple(block for block in self._blocks if has_block(ds, block))
        return tuple(self.inputs)

    def _columns(self, ds: TrajectoryDataset, block: str) -> tuple[str, ...]:
        if not has_block(ds, block):
            raise MissingFieldError(
                f"{type(self).__name__} was asked for the block {block!r}, but the episodes have "
                "none. Give it when the dataset is built, or leave it out of inputs=."
            )
        if block == "context":
            return tuple(
                f"{key}={value}"
                for key, values in self.context_categories_.items()
                for value in values
            )
        return {
            "state": ds.state_names,
            "action": ds.action_names,
            "params": ds.param_names,
            "previous": tuple(f"{name}-1" for name in ds.action_names),
            "references": tuple(
                f"{name}{at}" for at in self._knot_names() for name in ds.reference_names
            ),
            "phase": ("phase", "phase+h"),
        }.get(block, (block,))

    def _knot_names(self) -> tuple[str, ...]:
        """Suffixes of the reference columns: at t, at the knots between, at t + h."""
        between = (f"+{j}/{self.n_knots + 1}h" for j in range(1, self.n_knots + 1))
        return ("", *between, "+h")

    def get_feature_names_out(self, input_features: Any = None) -> NDArray[np.object_]:
        """Names of the columns of a row.

        Parameters
        ----------
        input_features : None
            Ignored; the names come from the episodes.

        Returns
        -------
        ndarray of str of shape (n_features,)
        """
        check_is_fitted(self, "layout_")
        return self.layout_.feature_names

    def context_rows(self, ds: TrajectoryDataset) -> Floats:
        """One-hot context of each episode.

        Parameters
        ----------
        ds : TrajectoryDataset

        Returns
        -------
        ndarray of shape (n, n_categories)

        Raises
        ------
        ValueError
            If an episode has a value that was not seen in `fit`.
        """
        blocks = [np.empty((len(ds), 0))]
        for key, categories in self.context_categories_.items():
            if key not in ds.context:
                raise MissingFieldError(f"the episodes have no context {key!r}, which fit saw.")
            values = ds.context[key]
            unseen = ~np.isin(values, categories)
            if unseen.any():
                raise ValueError(
                    f"episode {ds.ids[unseen][0]}: context {key!r} is "
                    f"{values[unseen][0].item()!r}, which fit did not see (it saw "
                    f"{categories.tolist()})."
                )
            blocks.append((values[:, None] == categories[None, :]).astype(np.float64))
        return np.concatenate(blocks, axis=1)

    def rows(self, ds: TrajectoryDataset, episode: Ints, begin: Ints, end: Ints) -> Floats:
        """Rows of pairs of states.

        Parameters
        ----------
        ds : TrajectoryDataset
        episode : ndarray of shape (n_rows,)
            Episode of each pair.
        begin, end : ndarray of shape (n_rows,)
            Its earlier and its later state, as rows of ``ds.states``.

        Returns
        -------
        ndarray of shape (n_rows, n_features)
        """
        out = np.empty((len(begin), self.layout_.width))
        for block, columns in self.layout_.items():
            out[:, columns] = self._values(ds, block, episode, begin, end)
        return out

    def _values(
        self, ds: TrajectoryDataset, block: str, episode: Ints, begin: Ints, end: Ints
    ) -> Floats:
        # take() copies whole rows, several times as fast as indexing with [rows]
        if block == "state":
            return ds.states.take(begin, axis=0)
        if block in ("horizon", "dt"):
            return time_differences(ds, episode, begin, end)[:, None]
        if block == "params":
            params = ds.step_params if ds.params_vary else ds.params
            if params is None:
                raise MissingFieldError("the episodes have no params, which fit saw.")
            if not ds.params_vary:
                return params.take(episode, axis=0)
            # no step begins at the last state: the theta that led there stays in force
            step = np.minimum(begin, ds.offsets[1:][episode] - 2) - episode
            return params.take(step, axis=0)
        if block == "context":
            return self.context_rows(ds).take(episode, axis=0)
        if block == "phase":
            return self.phase_rows(ds, episode, ds.times[begin], ds.times[end])
        if block in ("action", "previous"):
            if ds.actions is None:
                raise MissingFieldError("the episodes have no actions, which fit saw.")
            # an episode has one action less than states
            step = begin - episode
            if block == "previous":
                # before the first step its own action is as good a guess as any
                step = np.maximum(step - 1, ds.offsets[episode] - episode)
            return ds.actions.take(step, axis=0)
        return self.reference_rows(ds, begin, end)

    def phase_rows(
        self, ds: TrajectoryDataset, episode: Ints, begin: Floats, end: Floats
    ) -> Floats:
        """Phase at two times of episodes.

        Parameters
        ----------
        ds : TrajectoryDataset
        episode : ndarray of shape (n_rows,)
        begin, end : ndarray of shape (n_rows,)
            Absolute times.

        Returns
        -------
        ndarray of shape (n_rows, 2)

        Raises
        ------
        MissingFieldError
            If an episode has no `time_origin`.
        """
        origin = ds.time_origin[episode]
        if np.isnan(origin).any():
            raise MissingFieldError(
                f"episode {ds.ids[episode[np.isnan(origin)][0]]} has no time_origin, so its "
                "phase is unknown. Give it, or leave 'phase' out of inputs= and fit again."
            )
        return np.stack([begin - origin, end - origin], axis=1)

    def reference_rows(self, ds: TrajectoryDataset, begin: Ints, end: Ints) -> Floats:
        """References at t, at the knots between, and at t + h.

        Parameters
        ----------
        ds : TrajectoryDataset
        begin, end : ndarray of shape (n_rows,)
            Rows of ``ds.states``.

        Returns
        -------
        ndarray of shape (n_rows, (n_knots + 2) * d_r)
        """
        if ds.references is None:
            raise MissingFieldError("the episodes have no references, which fit saw.")
        t, h = ds.times[begin], ds.times[end] - ds.times[begin]
        between = [
            interpolate(ds.times, ds.references, begin, end, t + h * (j / (self.n_knots + 1)))
            for j in range(1, self.n_knots + 1)
        ]
        first, last = (ds.references.take(rows, axis=0) for rows in (begin, end))
        return np.concatenate([first, *between, last], axis=1)

    def fit_resample(self, X: Any, y: None = None) -> tuple[Floats, Floats]:
        """Rows and targets of the episodes.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None
            Must be omitted: the targets come from the episodes.

        Returns
        -------
        rows : ndarray of shape (n_rows, n_features)
        targets : ndarray of shape (n_rows, d_s), or (n_rows,) for rewards
        """
        if y is not None:
            raise ValueError("y must be omitted: the targets come from the episodes themselves.")
        ds = as_dataset(X)
        self.fit(ds)
        rows, targets, self.sample_indices_ = self._resample(ds, generator(self.random_state))
        return rows, targets

    @abstractmethod
    def _resample(
        self, ds: TrajectoryDataset, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Ints]:
        """Rows, targets and the episode of each row."""


def has_block(ds: TrajectoryDataset, block: str) -> bool:
    """Whether the episodes can fill a block."""
    return {
        "action": ds.actions is not None,
        "previous": ds.actions is not None,
        "params": ds.has_params,
        "references": ds.references is not None,
        "context": bool(ds.context),
        "phase": bool(np.isfinite(ds.time_origin).all()),
    }.get(block, True)
