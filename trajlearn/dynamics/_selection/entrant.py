"""A member in the hands of a selector: what it shows on the episodes that folds hold out."""

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.frozen import FrozenEstimator

from trajlearn.dynamics._members import unwrapped
from trajlearn.dynamics._selection.folds import FEW, Fold
from trajlearn.dynamics._selection.joint_folds import FoldFits
from trajlearn.dynamics.forecast import Forecast
from trajlearn.exceptions import DivergenceWarning, HorizonWarning
from trajlearn.trajectories import TrajectoryDataset

__all__ = ["Assessment", "Entrant", "judged", "policy_for_held_out"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Assessment:
    """A member, and its forecasts of held-out episodes.

    Attributes
    ----------
    name : str
    model : estimator
        Fitted on all episodes; of a member that left the race, on those of the fold that it left
        after, unless it smooths episodes.
    residuals : ndarray of shape (n, H, k)
        Logged minus forecast states, of the states that are logged; NaN where there is nothing
        to compare, inf from a divergence on.
    elapsed : ndarray of shape (n, H)
        Time from the start to each step; NaN likewise.
    state_names : tuple of str
    state_range : ndarray of shape (2, d_s)
    actions : {"none", "logged", "policy"}
        Where the forecasts took actions from.
    gives_std : bool
        Whether the model gives a standard deviation and samples.
    fit_seconds, predict_seconds : float
        Of all its fits, and of forecasting all episodes it was judged by.
    """

    name: str
    model: Any
    residuals: Floats
    elapsed: Floats
    state_names: tuple[str, ...]
    state_range: Floats
    actions: str
    gives_std: bool
    fit_seconds: float
    predict_seconds: float


class Entrant:
    """A member that is judged by some folds now, and perhaps by others later."""

    def __init__(
        self,
        name: str,
        member: Any,
        ds: TrajectoryDataset,
        folds: list[Fold],
        rng: np.random.Generator,
    ) -> None:
        self.name, self.frozen = name, isinstance(member, FrozenEstimator)
        self._model, self._ds, self._folds = member, ds, folds
        self._fits = None if self.frozen else FoldFits(member, ds, folds, rng=rng, std=False)
        self._seed = int(rng.integers(2**31))
        self._residuals: Floats | None = None
        self._elapsed = np.full((len(ds), int(ds.lengths.max())), np.nan)
        self._seconds = [0.0, 0.0]
        self._last: Forecast

    def judge(
        self, which: Sequence[int], whole: bool, policies: Mapping[int, Any], verbose: int
    ) -> None:
        """Fit on some folds, and on all episodes if `whole`; forecast what the folds hold out."""
        began = time.perf_counter()
        models = [self._model] * len(which)
        if self._fits is not None:
            models = self._fits.fit(which, whole=whole, policies=policies, verbose=verbose)
            self._model = models[0] if self._fits.model is None else self._fits.model
        fitted = time.perf_counter()
        policy = policy_for_held_out(self._model, self._ds) if whole else None
        for k, model in zip(which, models):
            self._forecast(model, self._folds[k][1], policy)
        self._seconds[0] += fitted - began
        self._seconds[1] += time.perf_counter() - fitted

    def _forecast(self, model: Any, test: Ints, policy: Any) -> None:
        held_out = self._ds[test]
        self._last = _forecast(model, held_out, self._seed, policy)
        missed = self._last.residuals(held_out)
        if self._residuals is None:
            self._residuals = np.full((*self._elapsed.shape, missed.shape[2]), np.nan)
        steps = missed.shape[1]
        self._residuals[test, :steps] = missed
        self._elapsed[test, :steps] = self._last.times - self._last.initial_times[:, None]

    def assessment(self, more_seconds: float = 0.0) -> Assessment:
        """What is known so far; some of the fitting took place elsewhere."""
        assert self._residuals is not None  # it was judged
        return Assessment(
            self.name,
            self._model,
            self._residuals,
            self._elapsed,
            self._last.state_names,
            self._last.state_range,
            self._last.actions,
            _gives_std(self._model, self._ds),
            self._seconds[0] + more_seconds,
            self._seconds[1],
        )


def judged(
    entrant: Entrant,
    which: Sequence[int],
    whole: bool,
    policies: Mapping[int, Any],
    verbose: int,
) -> Entrant:
    """The entrant itself, or what became of it in another process."""
    try:
        entrant.judge(which, whole, policies, verbose)
    except Exception as error:
        error.add_note(f"This happened to the member {entrant.name!r} of a HorizonSelector.")
        raise
    return entrant


def policy_for_held_out(model: Any, ds: TrajectoryDataset) -> Any:
    """With few episodes the policy that a member has cloned from all of them; else None, its own.

    How actions depend on four gains cannot be learned from four episodes, but often from five.
    Members that clone the policy would be told apart by what they make of a wrong one, and not by
    what they know of the plant; so it may have seen the episodes that they are judged by.

    Parameters
    ----------
    model : estimator
        Fitted on all episodes.
    ds : TrajectoryDataset
        All of them.
    """
    model = unwrapped(model)
    if getattr(model, "policy", None) != "clone" or len(ds) > FEW:
        return None
    # a closed loop has none
    return getattr(model, "policy_", None)


def _forecast(model: Any, ds: TrajectoryDataset, seed: int, policy: Any) -> Forecast:
    with warnings.catch_warnings():
        # who diverges is not chosen, and the report says who did
        for category in (DivergenceWarning, HorizonWarning):
            warnings.simplefilter("ignore", category)
        asked = {} if policy is None else {"policy": policy}
        found = model.predict(ds, random_state=seed, **asked)
    if not isinstance(found, Forecast):
        raise TypeError(
            f"{type(model).__name__} predicts {type(found).__name__}, not a Forecast: give "
            "dynamics estimators, or Pipelines that end in one."
        )
    return found


def _gives_std(model: Any, ds: TrajectoryDataset) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = model.predict(ds[:1], return_std=True, horizon=1, n_samples=2, random_state=0)
        except (TypeError, ValueError):
            # those written elsewhere say so in their own ways; whatever else is wrong comes again
            return False
    return found.std is not None and found.samples is not None
