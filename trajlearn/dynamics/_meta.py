"""Meta-estimators: forecasters that fit others and forecast by them."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from numpy.typing import ArrayLike
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from trajlearn.dynamics._episodes_only import EpisodesOnly
from trajlearn.dynamics._nested_defaults import NestedDefaults
from trajlearn.dynamics.forecast import Forecast

__all__ = ["ForecasterAround", "MetaForecaster", "forecaster_can"]


class MetaForecaster(NestedDefaults, EpisodesOnly):
    """Forecaster of episodes by others, of which only `predict` is used.

    A subclass defines `_defaults`, `fit` and `predict`, and sets `state_names_` and
    `state_range_`.
    """

    def _given(self) -> dict[str, Any]:
        """The forecasters to fit, by the name of the parameter: as given, or the default."""
        # not `or`: some estimators have a length, and an unfitted one has none
        return {
            name: default if getattr(self, name) is None else getattr(self, name)
            for name, default in self._defaults().items()
        }

    @abstractmethod
    def predict(self, X: Any, *args: Any, **settings: Any) -> Forecast:
        """Forecast episodes."""

    def forecast(self, X: Any, **settings: Any) -> Forecast:
        """Forecast episodes: the same as `predict`.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        **settings
            As in `predict`.

        Returns
        -------
        Forecast
        """
        return self.predict(X, **settings)

    def _ranged(self, found: Forecast) -> Forecast:
        """A forecast of another estimator with the training range of this one."""
        if found.state_names == self.state_names_:
            return found._replace(state_range=self.state_range_)
        # a transformer in front of the other one may have appended states, or left some out
        known = [name for name in self.state_names_ if name in found.state_names]
        state_range = found.state_range.copy()
        state_range[:, [found.state_names.index(name) for name in known]] = self.state_range_[
            :, [self.state_names_.index(name) for name in known]
        ]
        return found._replace(state_range=state_range)


def forecaster_can(name: str) -> Callable[[Any], bool]:
    """Check for `available_if`: whether the forecaster inside has a method, fitted or not yet."""

    def check(self: "ForecasterAround") -> bool:
        inner = self._forecaster
        return hasattr(self._given()[self._forecasts_by] if inner is None else inner, name)

    return check


class ForecasterAround(MetaForecaster):
    """Meta-estimator whose forecasts are those of one forecaster inside.

    What looks into a model finds that one (`trajlearn.dynamics._members.unwrapped`).
    """

    # its parameter; the fitted one is the attribute with an underscore behind it
    _forecasts_by: ClassVar[str]

    @property
    def _forecaster(self) -> Any:
        """The fitted forecaster inside, or None."""
        return getattr(self, f"{self._forecasts_by}_", None)

    def __sklearn_is_fitted__(self) -> bool:
        return self._forecaster is not None

    def predict(self, X: Any, return_std: bool = False, **settings: Any) -> Forecast:
        """Forecast episodes by the forecaster inside.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        return_std : bool, default=False
        **settings
            As in `forecast` of the forecaster inside.

        Returns
        -------
        Forecast
        """
        check_is_fitted(self)
        ds = self._episodes(X)
        return self._ranged(self._forecaster.predict(ds, return_std=return_std, **settings))

    @available_if(forecaster_can("predict_trajectory"))
    def predict_trajectory(
        self, initial_states: ArrayLike, *, horizons: ArrayLike, **settings: Any
    ) -> Forecast:
        """Predict from states and known signals alone, without a dataset: for planning.

        Parameters
        ----------
        initial_states : array-like of shape (n, d_s) or (d_s,)
        horizons : array-like of shape (H,)
            Times after the start.
        **settings
            As in `predict_trajectory` of the forecaster inside.

        Returns
        -------
        Forecast
        """
        check_is_fitted(self)
        found = self._forecaster.predict_trajectory(initial_states, horizons=horizons, **settings)
        return self._ranged(found)

    def _ends_with_log(self, ds: Any, actions: str, policy: Any) -> bool:
        inner = getattr(self._forecaster, "_ends_with_log", None)
        return inner is not None and inner(ds, actions, policy)
