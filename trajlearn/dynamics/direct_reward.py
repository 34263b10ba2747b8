"""Direct reward models: the mean reward per step from the first state and theta, no dynamics."""

from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import Interval, fit_context
from trajlearn.dynamics._base import TwoDoorRegressor
from trajlearn.dynamics._learner import spread
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors.gp import GPRegressor
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import EpisodeRelabeler, TrajectoryDataset, as_dataset, is_episodes
from trajlearn.trajectories._layout import Layout

__all__ = ["DirectRewardGP", "DirectRewardNN"]

Floats = NDArray[np.float64]


class _DirectReward(TwoDoorRegressor):
    """What the two share: all but the default learner."""

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **TwoDoorRegressor._parameter_constraints,
        "reward": [callable, None],
        "horizon": [Interval(Integral, 1, None, closed="left"), None],
        "terminal_reward": [Interval(Real, None, None, closed="neither"), None],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        relabeler: Any = None,
        scaler: Any = None,
        reward: Any = None,
        horizon: int | None = None,
        terminal_reward: float | None = None,
        random_state: Any = None,
    ) -> None:
        self.estimator = estimator
        self.relabeler = relabeler
        self.scaler = scaler
        self.reward = reward
        self.horizon = horizon
        self.terminal_reward = terminal_reward
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {
            "relabeler": EpisodeRelabeler(
                reward=self.reward, horizon=self.horizon, terminal_reward=self.terminal_reward
            ),
            "scaler": BlockScaler(),
        }

    def _layout_of_rows(self, n_features: int, n_targets: int) -> Layout:
        return Layout.of_rows(n_features, n_features, ("params",))

    def _fit_episodes(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        rows, rewards = self.relabeler_.fit_resample(ds)
        self.layout_ = self.relabeler_.layout_
        self._y_ndim = 1
        self._fit_rows(rows, rewards[:, None], weight, groups)

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        self.target_mean_ = np.average(targets, axis=0, weights=weight)
        largest = np.abs(targets).max(axis=0)
        self.target_scale_ = spread(targets - self.target_mean_, largest, weight)
        super()._fit_rows(rows, targets, weight, groups)

    def _learning_targets(self, rows: Floats, targets: Floats) -> tuple[Floats, Floats | None]:
        return (targets - self.target_mean_) / self.target_scale_, None

    def _restore(self, rows: Floats, means: Floats, variances: Floats) -> tuple[Floats, Floats]:
        return self.target_mean_ + self.target_scale_ * means, self.target_scale_**2 * variances

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Mean reward per step of each episode from its first state and theta, or of each row.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory, or array-like of shape (n, n_features)
        return_std : bool, default=False

        Returns
        -------
        mean : ndarray of shape (n,)
        std : ndarray of shape (n,), if asked for
        """
        check_is_fitted(self, "estimator_")
        if not is_episodes(X):
            return self._predict_rows(X, return_std)
        ds = as_dataset(X)
        widths = {"state": len(ds.state_names), "params": len(ds.param_names)}
        for block, width in widths.items():
            fitted = len(self.layout_.columns.get(block, ()))
            if block in self.layout_ and width != fitted:
                raise ValueError(
                    f"the episodes have {width} {block} columns, the model was fitted on {fitted}."
                )
        first = ds.offsets[:-1]
        rows = self.relabeler_.rows(ds, np.arange(len(ds)), first, first)
        return self._predict_rows_of(rows, return_std)

    def score(self, X: Any, y: ArrayLike | None = None, sample_weight: Any = None) -> float:
        """R^2 of the predicted rewards; `y` is for rows only.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory, or array-like of shape (n, n_features)
        y : array-like, for rows only
        sample_weight : array-like of shape (n,), optional

        Returns
        -------
        float
        """
        if is_episodes(X):
            if y is not None:
                raise ValueError("y must be omitted with episodes.")
            X = as_dataset(X)
            y = self.relabeler_.targets(X)
        return float(super().score(X, y, sample_weight))


class DirectRewardGP(_DirectReward):
    """Gaussian process from (s_0, theta) to the mean reward per step of an episode.

    Parameters
    ----------
    estimator : regressor or None, default=None
        None: `GPRegressor` (RBF, a length scale for each input).
    relabeler : EpisodeRelabeler or None, default=None
        None: made from `reward`, `horizon` and `terminal_reward`.
    scaler : transformer or None, default=None
        None: `BlockScaler`.
    reward : callable or None, default=None
        ``reward(states)`` of the states each step leads into (it may also name `actions`,
        `references`, `times`); None takes the logged rewards.
    horizon : int or None, default=None
        Steps of an episode; None takes those of the longest.
    terminal_reward : float or None, default=None
        What each step after an early termination is worth; needed where lengths differ.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    estimator_, relabeler_, scaler_
        As fitted.
    layout_ : mapping from block to slice
    n_features_in_ : int

    See Also
    --------
    DirectRewardNN : the same with a network.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import DirectRewardGP, TrajectoryDataset
    >>> theta = np.linspace(0, 1, 30)
    >>> states = np.tile(np.sin(3 * theta)[:, None, None], (1, 5, 1))
    >>> ds = TrajectoryDataset.from_arrays(states, params=theta[:, None])
    >>> model = DirectRewardGP(reward=lambda states: -states[..., 0] ** 2, random_state=0)
    >>> bool(model.fit(ds[::2]).score(ds[1::2]) > 0.99)
    True
    """

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> Self:
        """Fit on episodes, or on rows with targets.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory, or array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)
            Targets of rows; omitted for episodes.
        groups : array-like of shape (n,), optional
            Labels, for a learner that takes them.

        Returns
        -------
        self
        """
        return self._fit(X, y, None, groups)

    def _defaults(self) -> dict[str, Any]:
        return super()._defaults() | {"estimator": GPRegressor()}


class DirectRewardNN(_DirectReward):
    """Network from (s_0, theta) to the mean reward per step of an episode.

    Parameters
    ----------
    estimator : regressor or None, default=None
        None: an ensemble of 5 small networks with weight decay.
    relabeler : EpisodeRelabeler or None, default=None
        None: made from `reward`, `horizon` and `terminal_reward`.
    scaler : transformer or None, default=None
        None: `BlockScaler`.
    reward : callable or None, default=None
        As in `DirectRewardGP`.
    horizon : int or None, default=None
        Steps of an episode; None takes those of the longest.
    terminal_reward : float or None, default=None
        What each step after an early termination is worth; needed where lengths differ.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    estimator_, relabeler_, scaler_
        As fitted.
    layout_ : mapping from block to slice
    n_features_in_ : int

    See Also
    --------
    DirectRewardGP : the same with a Gaussian process; better from few episodes.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import DirectRewardNN, TrajectoryDataset
    >>> theta = np.linspace(0, 1, 60)
    >>> states = np.tile(np.sin(3 * theta)[:, None, None], (1, 5, 1))
    >>> ds = TrajectoryDataset.from_arrays(states, params=theta[:, None])
    >>> model = DirectRewardNN(reward=lambda states: -states[..., 0] ** 2, random_state=0)
    >>> bool(model.fit(ds[::2]).score(ds[1::2]) > 0.9)
    True
    """

    def _defaults(self) -> dict[str, Any]:
        estimator = MLPEnsembleRegressor(
            hidden_layer_sizes=(64, 64), activation="tanh", n_members=5, weight_decay=1e-2
        )
        return super()._defaults() | {"estimator": estimator}
