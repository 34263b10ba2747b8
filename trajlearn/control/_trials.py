"""What a search has asked for and was told: replaced whole, so that an error changes nothing."""

import warnings
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.exceptions import MissingFieldError, MixedSamplingError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.edits import concatenate
from trajlearn.trajectories.rewards import Reward, _logged
from trajlearn.trajectories.times import uniform_step

__all__ = ["Proposal", "Trials", "joined", "measured", "warn_of_ends"]

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
    """

    params: Floats
    reward: float | None = None
    std: float | None = None
    violation: float | None = None
    source: str = "model"


@dataclass(frozen=True, eq=False)
class Trials:
    """State of a search.

    `records` holds one value a trial: ``params`` (n, p), NaN where theta changes during the
    trial; ``total``, the sum of the rewards that were measured (or the return as given),
    ``missing``, the steps that a crash left out, ``least``, the least step reward; ``predicted``,
    ``std``, ``violation`` and ``source`` of the proposal.
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
    ids = np.arange(len(state), len(state) + len(ds))
    if old is None:
        ds = TrajectoryDataset._of(replace(ds._columns, ids=ids).freeze(), ds._names)
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
    ds = TrajectoryDataset._of(replace(ds._columns, ids=ids).freeze(), _names(old, ds))
    try:
        return ds, concatenate(old, ds)
    except ValueError as error:
        error.add_note("The first are the trials told before, number 2 is what is told now.")
        raise


def warn_of_ends(ds: TrajectoryDataset, is_terminal: Any, horizon: int) -> None:
    """Warn where trials ended early, but nothing says where predicted ones do."""
    early = ds.terminated & (ds.lengths < horizon)
    if is_terminal is None and early.any():
        warnings.warn(
            f"{early.sum()} trial(s) ended early, but is_terminal=None: predicted trials go on to "
            "the horizon whatever happens. Give is_terminal= and terminal_reward=, so that a "
            "predicted end costs what a real one does.",
            UserWarning,
            stacklevel=4,
        )


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


def measured(
    state: Trials, ds: TrajectoryDataset, reward: Reward | None, given: ArrayLike | None
) -> dict[str, NDArray[Any]]:
    """Records of new trials.

    Raises
    ------
    ValueError
        If a return is unknown or not finite; the message names the trial.
    """
    n = len(ds)
    params = np.stack([_one_theta(ds, i, state.horizon) for i in range(n)])
    by_hand = _given_returns(given, params)
    if by_hand is None and reward is None:
        ds.require("rewards", by="reward=None (the logged reward)")
    total, least, missing = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, dtype=np.intp)
    for i, episode in enumerate(ds):
        if by_hand is not None:
            total[i] = by_hand[i]
            continue
        rewards = _logged(episode, reward)[: state.horizon]
        if not np.isfinite(rewards).all():
            raise ValueError(
                f"trial {episode.id}: a step has the reward {rewards[~np.isfinite(rewards)][0]}, "
                "so the trial has no return: mend the reward function, or give reward=."
            )
        least[i] = rewards.min()
        if np.isnan(params[i]).any():
            continue
        total[i], missing[i] = rewards.sum(), state.horizon - len(rewards)
        if missing[i] and not episode.terminated:
            raise ValueError(
                f"trial {episode.id} has {episode.length} steps, fewer than the horizon of "
                f"{state.horizon}, and did not terminate by itself, so its return is unknown: log "
                "it longer, set terminated=True if it crashed, or give its return as reward=."
            )
    return {
        "params": params,
        "total": total,
        "least": least,
        "missing": missing,
        **_predicted(state, params),
    }


def _one_theta(ds: TrajectoryDataset, i: int, horizon: int) -> Floats:
    """Theta of a trial (p,), NaN if it changes before the horizon."""
    theta = ds[i].params
    if theta.ndim == 1:
        return theta
    steps = theta[:horizon]
    return steps[0] if (steps == steps[0]).all() else np.full(theta.shape[1], np.nan)


def _given_returns(given: ArrayLike | None, params: Floats) -> Floats | None:
    if given is None:
        return None
    values = np.asarray(given, dtype=np.float64)
    if values.ndim == 0 and len(params) == 1:
        values = values[None]
    if values.shape != (len(params),):
        raise ValueError(
            f"reward has shape {values.shape}: give one return for each of the {len(params)} "
            "trial(s)."
        )
    if not np.isfinite(values).all():
        raise ValueError(f"reward = {values[~np.isfinite(values)][0]} must be finite.")
    if np.isnan(params).any():
        raise ValueError(
            "theta changes during a trial, so there is no theta that its return belongs to: leave "
            "reward= out, the trial then only serves the model."
        )
    return values


def _predicted(state: Trials, params: Floats) -> dict[str, NDArray[Any]]:
    """What was predicted of the trials that follow the proposal; others were logged elsewhere."""
    n, proposal = len(params), state.pending
    predicted: dict[str, NDArray[Any]] = {
        name: np.full(n, np.nan) for name in ("predicted", "std", "violation")
    }
    source = np.full(n, "logged", dtype="U32")
    if proposal is not None:
        # files and robots round
        span = state.bounds[:, 1] - state.bounds[:, 0]
        follows = (np.abs(params - proposal.params) <= 1e-6 * span).all(axis=1)
        values = (proposal.reward, proposal.std, proposal.violation)
        for name, value in zip(predicted, values, strict=True):
            predicted[name][follows] = np.nan if value is None else value
        source[follows] = proposal.source
    return predicted | {"source": source}
