"""What the formulations share: two doors (rows, episodes), defaults, fitting, scoring."""

from abc import abstractmethod
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import RegressorMixin, clone
from sklearn.utils import Tags, check_random_state
from sklearn.utils.validation import _check_sample_weight, check_is_fitted, validate_data

from trajlearn._persistence import SaveMixin
from trajlearn._sklearn import HasMethods, fit_context
from trajlearn.dynamics._episode_arguments import checked_weight
from trajlearn.dynamics._learner import Moments, fit_learner, mixture, moments_of, seeded
from trajlearn.dynamics._nested_defaults import NestedDefaults
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.regressors._prediction import mean_of_members
from trajlearn.trajectories import TrajectoryDataset, as_dataset, is_episodes
from trajlearn.trajectories._layout import Layout

__all__ = ["TwoDoorRegressor"]

Floats = NDArray[np.float64]


class TwoDoorRegressor(SaveMixin, RegressorMixin, NestedDefaults):
    """Regressor of rows with targets, or of episodes that it relabels into them.

    A formulation says how rows are laid out, what its learner is to predict for a row, and what
    its defaults are.
    """

    estimator: Any
    relabeler: Any
    scaler: Any
    random_state: Any

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "estimator": [HasMethods(["fit", "predict"]), None],
        "relabeler": [HasMethods(["fit_resample"]), None],
        "scaler": [HasMethods(["fit", "transform"]), None],
        "random_state": ["random_state"],
    }

    # -- what a formulation defines -------------------------------------------------------

    @abstractmethod
    def _defaults(self) -> dict[str, Any]:
        """Default `estimator`, `relabeler` and `scaler`."""

    @abstractmethod
    def _layout_of_rows(self, n_features: int, n_targets: int) -> Layout:
        """Layout of plain rows, or a ValueError that says what is missing."""

    @abstractmethod
    def _fit_episodes(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        """Fit on episodes; `weight` (n,) and `groups` (n,) are by episode."""

    @abstractmethod
    def _learning_targets(self, rows: Floats, targets: Floats) -> tuple[Floats, Floats | None]:
        """What the learner predicts for each row, and a factor on the row's weight or None."""

    @abstractmethod
    def _restore(self, rows: Floats, means: Floats, variances: Floats) -> tuple[Floats, Floats]:
        """Undo `_learning_targets` on means and variances (..., n, d)."""

    # -- scikit-learn ---------------------------------------------------------------------

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    @fit_context(prefer_skip_nested_validation=True)
    def fit(
        self,
        X: Any,
        y: ArrayLike | None = None,
        *,
        sample_weight: ArrayLike | None = None,
        groups: ArrayLike | None = None,
    ) -> Self:
        """Fit on episodes, or on rows with targets.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory, or array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)
            Targets of rows; omitted for episodes.
        sample_weight : array-like of shape (n,), optional
            By row, or by episode: an episode of weight 2 counts as two.
        groups : array-like of shape (n,), optional
            Labels that a learner keeps together in early stopping and group bootstrap. For
            episodes the default is ``ds.group``, else the episode.

        Returns
        -------
        self
        """
        return self._fit(X, y, sample_weight, groups)

    def _fit(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> Self:
        seed = check_random_state(self.random_state).randint(2**31, size=4)
        self._rng = np.random.default_rng(seed)
        chosen = self._defaults()
        for name in chosen:
            # not `or`: some estimators have a length, and an unfitted one has none
            # a formulation may have its one learner, and no parameter for it
            if getattr(self, name, None) is not None:
                chosen[name] = getattr(self, name)
        self.estimator_ = seeded(chosen["estimator"], self._rng)
        self.relabeler_ = seeded(chosen["relabeler"], self._rng)
        self.scaler_ = clone(chosen["scaler"])
        if isinstance(X, (list, tuple)) and not len(X):
            raise InvalidEpisodeError("X is empty: give at least one episode, or rows and y.")
        if is_episodes(X):
            if y is not None:
                raise ValueError(
                    "y must be omitted with episodes: the targets come from the episodes "
                    "themselves. Give rows and y, or episodes alone."
                )
            self._fit_door_of_episodes(as_dataset(X), sample_weight, groups)
        else:
            self._fit_door_of_rows(X, y, sample_weight, groups)
        del self._rng
        return self

    def _fit_door_of_episodes(self, ds: TrajectoryDataset, sample_weight: Any, groups: Any) -> None:
        weight = None
        if sample_weight is not None:
            weight = checked_weight(sample_weight, len(ds))
        if groups is None:
            groups = np.arange(len(ds)) if ds.group is None else ds.group
        groups = np.asarray(groups)
        if groups.shape != (len(ds),):
            raise ValueError(
                f"groups has shape {groups.shape}; give one label an episode ({len(ds)})."
            )
        if weight is not None and not weight.all():
            keep = weight > 0
            ds, weight, groups = ds[keep], weight[keep], groups[keep]
        if hasattr(self, "feature_names_in_"):
            del self.feature_names_in_
        self._y_ndim = 2
        self._fit_episodes(ds, weight, groups)
        self.n_features_in_ = self.layout_.width

    def _fit_door_of_rows(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> None:
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        y = np.asarray(y, dtype=np.float64)
        self._y_ndim = y.ndim
        y = y[:, None] if y.ndim == 1 else y
        weight = None
        if sample_weight is not None:
            weight = _check_sample_weight(
                sample_weight, X, dtype=np.float64, ensure_non_negative=True
            )
            keep = weight > 0
            if not keep.any():
                raise ValueError("sample_weight is zero everywhere; give at least one row some.")
            X, y, weight = X[keep], y[keep], weight[keep]
            groups = None if groups is None else np.asarray(groups)[keep]
        self.layout_ = self._layout_of_rows(X.shape[1], y.shape[1])
        self.relabeler_.layout_ = self.layout_
        self.relabeler_.context_categories_ = {}
        self._fit_rows(X, y, weight, groups)

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        """Scale, then learn."""
        self._fit_scaler(rows, weight)
        z, factor = self._learning_targets(rows, targets)
        if factor is not None:
            weight = factor if weight is None else factor * weight
        self.estimator_ = fit_learner(
            self.estimator_, self._scaled(rows), z, weight=weight, groups=groups
        )

    def _fit_scaler(self, rows: Floats, weight: Floats | None) -> None:
        if isinstance(self.scaler_, BlockScaler):
            self.scaler_.fit(rows, layout=self.layout_, sample_weight=weight)
        else:
            self.scaler_.fit(rows)

    def _scaled(self, rows: Floats) -> Floats:
        if isinstance(self.scaler_, BlockScaler):
            return self.scaler_.scaled(rows)
        return np.asarray(self.scaler_.transform(rows), dtype=np.float64)

    def _moments(self, *, means_only: bool = False) -> Moments:
        """Function from raw rows to means and variances of the targets, by member."""
        learner = moments_of(self.estimator_, means_only=means_only)

        def moments(rows: Floats) -> tuple[Floats, Floats | None]:
            means, variances = learner(self._scaled(rows))
            known = np.zeros_like(means) if variances is None else variances
            means, known = self._restore(rows, means, known)
            return means, None if variances is None else known

        return moments

    def _predict_rows(self, X: Any, return_std: bool) -> Any:
        check_is_fitted(self, "estimator_")
        return self._predict_rows_of(
            validate_data(self, X, reset=False, dtype=np.float64), return_std
        )

    def _predict_rows_of(self, rows: Floats, return_std: bool) -> Any:
        means, variances = self._moments(means_only=not return_std)(rows)
        mean = mean_of_members(means)
        shape = (slice(None), 0) if self._y_ndim == 1 else slice(None)
        if not return_std:
            return mean[shape]
        return mean[shape], np.sqrt(mixture(means, variances, self.estimator_)[1])[shape]
