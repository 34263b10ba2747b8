"""Planners of the cartpole, their trials, and what a model says of the choices that they face."""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.paper._control_tasks import CONTROL_TASKS
from benchmarks.paper._models import build
from trajlearn import Cartpole, TrajectoryDataset
from trajlearn.control import MPC, PredictedReturn

Floats = NDArray[np.float64]

TASK = CONTROL_TASKS["cartpole"]
LENGTH = TASK.length
N_TRAIN = 100
N_TRIALS = {"full": 25, "quick": 6}
#: Of a planner that is costly: its trials are shared out among the training seeds.
N_COSTLY = {"full": 15, "quick": 2}
N_CANDIDATES = {"full": 1000, "quick": 200}
#: Trials of one cell of a costly planner.
CHUNK = 3
# a trajectory model gives the reward of every tenth step, linear in between
EVERY = 10
# states of a trial from which choices are looked at, and parameters that are compared there
_LOOKED_AT_STEPS = (0, 25, 50, 100)
N_CHOICES = 200
#: Return per step below which gains are bad.
BAD = 0.5


class Planner(NamedTuple):
    """How a planner decides; `model` None is a reference that plans nothing."""

    model: str | None
    hold: int | str = "all"
    horizon: int = LENGTH
    decision: str = "params"
    costly: bool = False


#: "T, own starts" is T on a log that begins where trials begin, with the episodes that fell.
PLANNERS = {
    "T, hold all": Planner("T"),
    "T, hold 25": Planner("T", 25),
    "T, hold 5": Planner("T", 5, costly=True),
    "T, hold 1": Planner("T", 1, costly=True),
    "T, hold 1, horizon 25": Planner("T", 1, 25, costly=True),
    "T, own starts, hold all": Planner("T, own starts"),
    "T, own starts, hold 25": Planner("T, own starts", 25),
    "D over policies, hold all": Planner("D"),
    "D over policies, hold 25": Planner("D", 25, costly=True),
    "D over policies, hold 1, horizon 25": Planner("D", 1, 25, costly=True),
    "D over actions, hold all": Planner("D", decision="actions"),
    "D over actions, hold 1, horizon 25": Planner("D", 1, 25, "actions", costly=True),
    "LQR": Planner(None),
    "random policy": Planner(None),
    "simulator, hold all": Planner(None),
}
#: Planners whose states are looked at.
LOOKED_AT = ["T, hold all", "T, hold 25"]


def ordered(names: Iterable[str]) -> list[str]:
    """Planners among the names, in the order in which they are shown."""
    present = set(names)
    return [name for name in PLANNERS if name in present]


def starts(n: int) -> Floats:
    """The first n of the common starts (n, 4): position and angle within 0.25."""
    return TASK.common_starts[:n]


def bounds() -> Floats:
    """Gains that the log was flown with (4, 2); planners choose among them."""
    return Cartpole().param_bounds


def lqr_gain() -> Floats:
    """Gain (4,) that the factors of the log multiply."""
    return Cartpole().lqr_gain


def log(model: str, seed: int) -> TrajectoryDataset:
    """Episodes that a model is trained on."""
    if model != "T, own starts":
        return Cartpole(redraw_terminated=True).collect(N_TRAIN, LENGTH, random_state=seed)
    at = TASK.starts(N_TRAIN, np.random.default_rng([seed, 1]))
    return TASK.env.rollout(at, TASK.env.sample_params(N_TRAIN, seed), LENGTH)


@lru_cache(maxsize=3)
def fitted(model: str, mode: str, seed: int) -> Any:
    """A model with the library's defaults, fitted once in a process."""
    kind = "D" if model == "D" else "T"
    estimator = build(kind, "default", policy=TASK.env.policy, mode=mode, seed=seed)
    return estimator.fit(log(model, seed))


def mpc(model: Any, how: Planner, n_candidates: int, seed: Any) -> MPC:
    """Random shooting by a planner's settings."""
    return MPC(
        model,
        bounds=bounds() if how.decision == "params" else TASK.env.action_bounds,
        reward=TASK.reward,
        horizon=how.horizon,
        decision=how.decision,
        n_candidates=n_candidates,
        hold=how.hold,
        every=EVERY if how.horizon > EVERY and how.model != "D" else 1,
        is_terminal=TASK.is_terminal,
        terminal_reward=TASK.terminal_reward,
        random_state=seed,
    )


def references(name: str, at: Floats, n_candidates: int, seed: int) -> Floats:
    """Gains (n, 4) of a reference from each start."""
    rng = np.random.default_rng([seed, 2])
    low, high = bounds().T
    if name == "LQR":
        return np.tile(lqr_gain(), (len(at), 1))
    if name == "random policy":
        return rng.uniform(low, high, size=(len(at), 4))
    candidates = rng.uniform(low, high, size=(n_candidates, 4))
    return np.stack([candidates[true_returns(start, candidates).argmax()] for start in at])


def true_returns(start: Floats, params: Floats, length: int = LENGTH) -> Floats:
    """Return per step (m,) of gains (m, 4), each held from one state, in the simulator."""
    flown = TASK.env.rollout(np.tile(start, (len(params), 1)), params, length)
    return np.array([TASK.reward(e.states[1:]).sum() for e in flown]) / length


def cell(planner: str, trials: list[int], mode: str, seed: int) -> list[dict[str, Any]]:
    """One record a trial: its return, how long it stood, what planning took."""
    how, n_candidates = PLANNERS[planner], N_CANDIDATES[mode]
    at = starts(N_TRIALS[mode])[trials]
    if how.model is None:
        theta = references(planner, at, n_candidates, seed)
        return records(trials, TASK.env.rollout(at, theta, LENGTH))
    # one worker's numbers do not depend on which trials another has
    control = mpc(fitted(how.model, mode, seed), how, n_candidates, 1000 * seed + trials[0])
    flown = control.run(TASK.env, at, LENGTH)
    made = control.decisions_.groupby("trial")
    planned = made["value"].first() / how.horizon
    seconds, summed = made["seconds"].median(), made["seconds"].sum()
    return [
        record
        | {
            "predicted": float(planned[i]),
            "decision_s": float(seconds[i]),
            "trial_s": float(summed[i]),
            "n_decisions": len(made.get_group(i)),
        }
        for i, record in enumerate(records(trials, flown))
    ]


def records(trials: list[int], flown: TrajectoryDataset) -> list[dict[str, Any]]:
    """What is kept of every trial."""
    returns = TASK.returns(flown)
    return [
        {
            "trial": number,
            "return": float(some),
            "steps": episode.length,
            "fell": bool(episode.terminated),
            "changes": _changes(episode.params),
        }
        for number, some, episode in zip(trials, returns, flown, strict=True)
    ]


def _changes(params: Floats | None) -> int | None:
    """How often theta changed during a trial."""
    if params is None:
        return None
    return 0 if params.ndim == 1 else int((params[1:] != params[:-1]).any(axis=1).sum())


def choices(planner: str, model: str, mode: str, seed: int) -> list[dict[str, Any]]:
    """What a model says of a choice of gains, at states of a planner's trials.

    At each state: how well predicted returns of the same random gains, held to the end of the
    trial, rank the true ones, what the gains that it would take are truly worth, and the share of
    gains that fall.
    """
    how = PLANNERS[planner]
    at = starts(N_TRIALS[mode])[:8]
    control = mpc(fitted(str(how.model), mode, seed), how, N_CANDIDATES[mode], 1000 * seed)
    flown = control.run(TASK.env, at, LENGTH)
    judge = fitted(model, mode, seed)
    low, high = bounds().T
    lines = []
    for trial, episode in enumerate(flown):
        for step in _LOOKED_AT_STEPS:
            if step >= episode.length:
                continue
            rng = np.random.default_rng([seed, trial, step])
            theta, left = rng.uniform(low, high, size=(N_CHOICES, 4)), LENGTH - step
            true = true_returns(episode.states[step], theta, left)
            assess = PredictedReturn(
                judge,
                reward=TASK.reward,
                horizon=left,
                initial_states=episode.states[step],
                is_terminal=TASK.is_terminal,
                terminal_reward=TASK.terminal_reward,
                every=1 if model == "D" else EVERY,
            )
            predicted = assess(theta).value / left
            pick = int(predicted.argmax())
            lines.append(
                {
                    "trial": trial,
                    "step": step,
                    "rank": float(spearmanr(predicted, true).statistic),
                    "predicted": float(predicted[pick]),
                    "true": float(true[pick]),
                    "best": float(true.max()),
                    "mean": float(true.mean()),
                    "speed_factor": float(theta[pick, 1] / lqr_gain()[1]),
                    "rate_factor": float(theta[pick, 3] / lqr_gain()[3]),
                    "low": float(np.mean(true < BAD)),
                    "pick_low": bool(true[pick] < BAD),
                }
            )
    return lines
