"""What a search has asked for and was told: replaced whole, so that an error changes nothing."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import MissingFieldError, MixedSamplingError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.edits import concatenate
from trajlearn.trajectories.times import uniform_step

__all__ = ["Proposal", "Trials", "joined"]

Floats = NDArray[np.float64]
# fields of a dataset that models do without: dropped where only some trials have them
_DISPENSABLE = ("rewards", "group")


@dataclass(frozen=True, eq=False)
class Proposal:
    """Parameters to try next, and what was predicted of them.

    Parameters
    ----------
    params : ndarray of shape (p,)
    reward, std : float or None
        Predicted return of the trial and its standard deviation.
    violation : float or None
        Predicted probability that some state of the trial violates the constraint.
    source : str
        What proposed it: ``"sobol"``, ``"model"``, ...
    expected : float or None
        Predicted mean return, which `std` is about; `reward` may be that of a mean trajectory.
    """

    params: Floats
    reward: float | None = None
    std: float | None = None
    violation: float | None = None
    source: str = "model"
    expected: float | None = None


@dataclass(frozen=True, eq=False)
class Trials:
    """State of a search.

    `records` holds one value a trial: ``params`` (n, p), NaN where theta changes during the
    trial; ``total``, the sum of the rewards that were measured (or the return as given),
    ``missing``, the steps that a crash left out, ``least``, the least step reward, NaN if the
    return was given; ``predicted``, ``expected``, ``std``, ``violation`` and ``source`` of the
    proposal.
    """

    seed: int
    bounds: Floats
    horizon: int
    n_asked: int = 0
    pending: Proposal | None = None
    last: Floats | None = None
    data: TrajectoryDataset | None = None
    records: dict[str, NDArray[Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return 0 if self.data is None else len(self.data)

    def differing(self, bounds: Floats, horizon: int) -> list[str]:
        """How bounds and a horizon differ from those of the search, in words."""
        found = []
        if bounds.shape != self.bounds.shape:
            found.append(f"p = {len(bounds)} here, {len(self.bounds)} there")
        elif not np.array_equal(bounds, self.bounds):
            found.append(f"bounds = {bounds.tolist()} here, {self.bounds.tolist()} there")
        if horizon != self.horizon:
            found.append(f"horizon = {horizon} here, {self.horizon} there")
        return found

    def returns(self, terminal_reward: float | None) -> Floats:
        """Return of each trial (n,), NaN where theta changed on the way."""
        if self.data is None:
            return np.empty(0)
        missing = self.records["missing"]
        price = self.least_reward() if terminal_reward is None else terminal_reward
        # no trial misses a step if no reward was measured
        return self.records["total"] + np.where(missing > 0, missing * (price or 0.0), 0.0)

    def least_reward(self) -> float | None:
        """The least step reward in any trial; None if all returns were given by hand."""
        least = self.records.get("least", np.empty(0))
        known = least[~np.isnan(least)]
        return float(known.min()) if len(known) else None

    def told(
        self, data: TrajectoryDataset, records: dict[str, NDArray[Any]], n_new: int
    ) -> "Trials":
        """The state after a tell: `data` of all trials, `records` of the new ones."""
        assert len(data) == len(self) + n_new
        if self.records:
            records = {
                name: np.concatenate([old, records[name]]) for name, old in self.records.items()
            }
        last = self.last if self.pending is None else self.pending.params
        return replace(self, pending=None, last=last, data=data, records=records)


def joined(state: Trials, ds: TrajectoryDataset) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """The new trials with params and names, and all trials with them.

    Raises
    ------
    ValueError
        If the new trials do not fit the search or the trials before.
    """
    p, old = len(state.bounds), state.data
    if not ds.has_params:
        if state.pending is None:
            raise MissingFieldError(
                "the trial has no params, and no proposal is waiting for it: ask() first, or tell "
                "a trajectory with params."
            )
        ds = ds.assign(params=np.tile(state.pending.params, (len(ds), 1)))
    if len(ds.param_names) != p:
        raise ValueError(
            f"the trial has {len(ds.param_names)} params, bounds= says {p} ({p} rows)."
        )
    dt = _step_of(ds)
    ds = ds.assign(ids=list(range(len(state), len(state) + len(ds))))
    if old is None:
        return ds, ds
    if len(ds.state_names) != len(old.state_names):
        raise ValueError(
            f"the trial has {len(ds.state_names)} states a step, the trials before have "
            f"{len(old.state_names)} ({', '.join(old.state_names)})."
        )
    dt_before = _step_of(old)
    if abs(dt - dt_before) > 1e-3 * dt_before:
        raise MixedSamplingError(
            f"the trial has a time step of {dt:g}, the trials before have {dt_before:g}: resample "
            f"it first (ds.resample({dt_before:g}))."
        )
    for name in _DISPENSABLE:
        if getattr(old, name) is None:
            ds = ds.assign(**{name: None})
        elif getattr(ds, name) is None:
            old = old.assign(**{name: None})
    ds = TrajectoryDataset._of(ds._columns, _names(old, ds))
    try:
        return ds, concatenate(old, ds)
    except ValueError as error:
        error.add_note("The first are the trials told before, number 2 is what is told now.")
        raise


def _step_of(ds: TrajectoryDataset) -> float:
    try:
        return uniform_step(ds)
    except MixedSamplingError as error:
        raise MixedSamplingError(
            "the time step varies inside the trials, so a horizon in steps means different things: "
            "resample them first (ds.resample(dt))."
        ) from error


def _names(old: TrajectoryDataset, ds: TrajectoryDataset) -> dict[str, tuple[str, ...]]:
    """Names of the trials before for trials without any (a `Trajectory` has none)."""
    names = dict(ds._names)
    for name, given in ds._names.items():
        known = old._names.get(name, ())
        numbered = (_is_numbered(given), _is_numbered(known))
        if len(known) == len(given) and any(numbered):
            names[name] = known
    return names


def _is_numbered(names: tuple[str, ...]) -> bool:
    prefixes = ("s", "a", "theta", "ref")
    return any(names == tuple(f"{prefix}{i}" for i in range(len(names))) for prefix in prefixes)
