"""What a log is worth in which theta changes on the way: rows, errors and trials after refitting.

A model plans ten trials and is fitted anew with them. Sub-trajectories come only from stretches
of constant theta, so the longer a decision is held, the more there are, and the longer.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._models import build
from benchmarks.paper._planning_trials import LENGTH, TASK, Planner, bounds, mpc, records
from benchmarks.paper._rollouts import expected_warnings, shown_horizons
from trajlearn import Cartpole, TrajectoryDataset

Floats = NDArray[np.float64]

N_FIRST = 20
N_MORE = {"full": 10, "quick": 4}
N_TEST = {"full": 100, "quick": 30}
# fewer than the other trials get: a decision at every step is to stay affordable
N_CANDIDATES = {"full": 300, "quick": 100}
#: How long a decision is held in the trials that are added; None adds none.
HOLDS: list[int | str | None] = [None, 1, 25, "all", "random"]
# how long it is held in the trials that show what the model is worth
_HELD_AFTER = 25
#: Horizons at which rows are counted.
COUNTED = [1, 5, 10, 25, 50, 100, 150, 200]


def cell(hold: int | str | None, mode: str, seed: int) -> dict[str, Any]:
    """Fit on 20 episodes, add trials, fit again: rows, errors of new episodes, next trials.

    `hold` "random" adds as many episodes under random gains, each constant, instead of planned
    ones; None adds nothing.
    """
    n_more, rng = N_MORE[mode], np.random.default_rng([seed, 3])
    first = Cartpole(redraw_terminated=True).collect(N_FIRST, LENGTH, random_state=seed)
    at, later, beyond = (TASK.starts(n, rng) for n in (n_more, n_more, N_TEST[mode]))
    train, added = first, None
    if hold == "random":
        added = TASK.env.rollout(at, TASK.env.sample_params(n_more, 7000 + seed), LENGTH)
    elif hold is not None:
        before = _fit(first, mode, seed)
        added = mpc(before, Planner("T", hold), N_CANDIDATES[mode], seed).run(TASK.env, at, LENGTH)
    if added is not None:
        train = _joined(first, added)
    model = _fit(train, mode, seed)
    after = mpc(model, Planner("T", _HELD_AFTER), N_CANDIDATES[mode], 5000 + seed)
    low, high = bounds().T
    theta = rng.uniform(low, high, size=(len(beyond), 4))
    test = TASK.env.rollout(beyond, theta, LENGTH)
    spread = np.ptp(first.states, axis=0)
    return {
        "rows": {"horizon": COUNTED, "rows": usable(added)},
        "added": [] if added is None else records(list(range(n_more)), added),
        "next": records(list(range(n_more)), after.run(TASK.env, later, LENGTH)),
        "errors": errors(model, test[test.lengths == LENGTH], spread),
    }


def label(hold: int | str | None) -> str:
    """Name of what was added to the first log."""
    if hold is None:
        return "nothing"
    return "random gains" if hold == "random" else f"planned, hold {hold}"


#: Of all logs, in the order in which they are shown.
LABELS = [label(hold) for hold in HOLDS]


def _fit(ds: TrajectoryDataset, mode: str, seed: int) -> Any:
    return build("T", "default", policy=None, mode=mode, seed=seed).fit(ds)


def _joined(first: TrajectoryDataset, added: TrajectoryDataset) -> TrajectoryDataset:
    """Both logs as one; theta of the first at each step, as in the second."""
    by_step = [np.tile(e.params, (e.length, 1)) if e.params.ndim == 1 else e.params for e in added]
    constant = [np.tile(e.params, (e.length, 1)) for e in first]
    return first.assign(params=constant).concatenate(
        added.assign(params=by_step, param_names=first.param_names)
    )


def usable(ds: TrajectoryDataset | None) -> list[int]:
    """Sub-trajectories of each of `COUNTED` steps under constant theta."""
    if ds is None:
        return [0] * len(COUNTED)
    runs = np.concatenate([_runs(episode.params, episode.length) for episode in ds])
    return [int(np.maximum(runs - h + 1, 0).sum()) for h in COUNTED]


def _runs(params: Floats, length: int) -> NDArray[np.intp]:
    """Steps of each stretch of constant theta."""
    if params.ndim == 1:
        return np.array([length])
    changes = np.flatnonzero((params[1:] != params[:-1]).any(axis=1)) + 1
    return np.diff(np.concatenate([[0], changes, [length]]))


def errors(model: Any, test: TrajectoryDataset, spread: Floats) -> dict[str, list[float]]:
    """Median squared error by horizon, states scaled by the range of the first log."""
    with expected_warnings():
        forecast = model.predict(test)
    truth = np.stack([episode.states[1:] for episode in test])
    with np.errstate(over="ignore", invalid="ignore"):
        squared = (((forecast.mean - truth) / spread) ** 2).mean(axis=2)
    squared = np.where(np.isfinite(squared), squared, np.inf)
    shown = [h for h in shown_horizons(LENGTH).tolist() if h <= LENGTH]
    return {
        "horizon": [float(h) for h in shown],
        "median": [float(np.median(squared[:, h - 1])) for h in shown],
        "mean": [float(np.mean(squared[:, h - 1])) for h in shown],
    }
