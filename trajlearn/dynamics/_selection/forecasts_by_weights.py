"""Forecasts of several members, each with the weight that it has at a horizon."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from trajlearn.dynamics._forecaster import check_n_samples
from trajlearn.dynamics._meta import MetaForecaster
from trajlearn.dynamics._selection.held_out_noise import HeldOutNoise
from trajlearn.dynamics._selection.mixed_forecast import Part, cut_after, mixed, shortened
from trajlearn.dynamics._selection.named_members import NamedMembers
from trajlearn.dynamics._uncertainty.conformal import steps_of
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import DivergenceWarning
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._relabeler import generator

__all__ = ["ForecastsByWeights", "members_can"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
# asks a fitted member for a forecast of so many steps, with keywords
Asked = Callable[..., Forecast]


def members_can(name: str) -> Callable[[Any], bool]:
    """Check for `available_if`: the members have a method; of a fitted choice, the chosen ones."""

    def check(self: "ForecastsByWeights") -> bool:
        members = self._named()
        if hasattr(self, "weights_"):
            used = np.flatnonzero(self.weights_.any(axis=0))
            members = {self.names_[i]: self.estimators_[i] for i in used}
        lacking = [
            key
            for key, member in members.items()
            if not isinstance(member, str) and not hasattr(member, name)
        ]
        if lacking:
            raise AttributeError(
                f"members without {name}: {', '.join(lacking)}. Leave them out ('drop'), or take "
                "predict, which every member has."
            )
        return True

    return check


class ForecastsByWeights(NamedMembers, MetaForecaster):
    """Forecaster by fitted members and the weight of each at each step."""

    names_: tuple[str, ...]
    estimators_: list[Any]
    weights_: Floats
    # of members that give no standard deviation
    _noise: list[HeldOutNoise | None]
    # time from the start to each step
    _elapsed: Floats
    # where each member takes actions from
    _sources: tuple[str, ...]

    def predict(
        self,
        X: Any,
        return_std: bool = False,
        *,
        start: ArrayLike = 0,
        horizon: int | None = None,
        actions: str = "auto",
        policy: Any = None,
        n_samples: int | None = None,
        random_state: Any = None,
    ) -> Forecast:
        """Forecast episodes; each member once, to the longest horizon at which it has weight.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        return_std : bool, default=False
        start, horizon, actions, policy, n_samples, random_state
            As in `forecast` of the members.

        Returns
        -------
        Forecast
        """
        check_is_fitted(self, "weights_")
        ds = self._episodes(X)
        n_steps = int(ds.lengths.max())
        # members refuse a horizon that is none
        if isinstance(horizon, (int, np.integer)) and horizon > 0:
            n_steps = int(horizon)

        def ask(member: Any, reach: int, **settings: Any) -> Forecast:
            of, to = ds, horizon
            if reach < n_steps and horizon is None:
                of = cut_after(ds, start, reach)
            elif reach < n_steps:
                to = reach
            return member.predict(
                of, start=start, horizon=to, actions=actions, policy=policy, **settings
            )

        found = self._mixture(np.arange(n_steps), ask, return_std, n_samples, random_state)
        source = self._source(found, actions, policy)
        if source == "logged":
            episode = np.arange(len(ds)) if found.episode is None else found.episode
            found = shortened(found, ds.lengths[episode] - found.start)
        return self._ranged(found._replace(actions=source))

    @available_if(members_can("predict_trajectory"))
    def predict_trajectory(
        self,
        initial_states: ArrayLike,
        *,
        horizons: ArrayLike,
        return_std: bool = False,
        n_samples: int | None = None,
        random_state: Any = None,
        **signals: Any,
    ) -> Forecast:
        """Predict from states and known signals alone, without a dataset: for planning.

        Parameters
        ----------
        initial_states : array-like of shape (n, d_s) or (d_s,)
        horizons : array-like of shape (H,)
            Times after the start. Who predicts each is chosen as at the next step at or after it.
        return_std, n_samples, random_state
            As in `predict`.
        **signals
            As in `predict_trajectory` of the members; they must agree on arrays by step.

        Returns
        -------
        Forecast
        """
        check_is_fitted(self, "weights_")
        wanted = np.atleast_1d(np.asarray(horizons, dtype=np.float64))
        if not wanted.size:
            raise ValueError("horizons is empty: give the times after the start to predict at.")
        # arrays by step have as many rows as there are steps to the last horizon
        whole = any(
            signals.get(name) is not None and not callable(signals[name])
            for name in ("actions", "references")
        )

        def ask(member: Any, reach: int, **settings: Any) -> Forecast:
            some = wanted if whole else wanted[:reach]
            return member.predict_trajectory(initial_states, horizons=some, **settings, **signals)

        steps = steps_of(wanted, self._elapsed)
        found = self._mixture(steps, ask, return_std, n_samples, random_state)
        given = "auto" if signals.get("actions") is None else "logged"
        source = self._source(found, given, signals.get("policy"))
        return self._ranged(found._replace(actions=source))

    def _mixture(
        self, steps: Ints, ask: Asked, return_std: bool, n_samples: int | None, random_state: Any
    ) -> Forecast:
        """Mixture of the members that have weight at some of the steps (H,), counted from 0."""
        check_n_samples(n_samples)
        weights = self.weights_[np.minimum(steps, len(self.weights_) - 1)]
        rng = np.random.default_rng() if random_state is None else generator(random_state)
        seeds = rng.integers(2**31, size=len(self.names_))
        parts = []
        for i in np.flatnonzero((weights > 0).any(axis=0)):
            noise = self._noise[i]
            settings: dict[str, Any] = {}
            if random_state is not None or n_samples:
                settings["random_state"] = int(seeds[i])
            if noise is None:
                settings |= {"return_std": return_std, "n_samples": n_samples}
            reach = int(np.flatnonzero(weights[:, i])[-1]) + 1
            with warnings.catch_warnings():
                # told once for all members, below
                warnings.simplefilter("ignore", DivergenceWarning)
                found = ask(self.estimators_[i], reach, **settings)
            parts.append(Part(found, weights[:, i], noise, steps))
        forecast = mixed(parts, return_std=return_std, n_samples=n_samples, rng=rng)
        if forecast.diverged_at.any():
            gone = forecast.diverged_at[forecast.diverged_at > 0]
            warnings.warn(
                f"{len(gone)} of {len(forecast)} forecasts diverged (first at step {gone.min()}): "
                "their states are inf from there on. report('member') says who diverged on "
                "held-out episodes; clip_states= of one-step members bounds them.",
                DivergenceWarning,
                stacklevel=3,
            )
        return forecast

    def _source(self, found: Forecast, actions: str, policy: Any) -> str:
        """Where members take actions from, chosen ones or not: the same for all horizons."""
        if set(self._sources) == {"none"}:
            return "none"
        if actions == "auto" and policy is None:
            return "logged" if "logged" in self._sources else "policy"
        if found.actions != "none":
            return found.actions
        return "policy" if actions == "auto" else actions

    def _ends_with_log(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        asked = [getattr(member, "_ends_with_log", None) for member in self.estimators_]
        return any(ends is not None and ends(ds, actions, policy) for ends in asked)
