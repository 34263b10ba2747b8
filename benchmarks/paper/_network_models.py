"""Networks as controllers of the cartpole: episodes, models of them, and searches on these."""

import time
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr
from sklearn.cluster import KMeans
from sklearn.pipeline import make_pipeline

from benchmarks.paper._control_tasks import CONTROL_TASKS
from benchmarks.paper._models import build
from benchmarks.paper._rollouts import expected_warnings
from trajlearn import (
    DirectRewardGP,
    NetworkPolicy,
    ParamsTransformer,
    TrajectoryDataset,
    horizon_errors,
)
from trajlearn.control import PredictedReturn
from trajlearn.control._optimizers import maximise

Floats = NDArray[np.float64]

TASK = CONTROL_TASKS["cartpole"]
LENGTH = TASK.length
POLICY = NetworkPolicy((5,), n_states=4, n_actions=1)
#: What the weights of each input are divided by: the limits of position and angle, fast speeds.
INPUT_SCALE = (9.6, 5.0, 0.42, 2.0)
#: Half the width of the draw of scaled input weights, output weights, and biases.
WIDTHS = {"input": 2.0, "output": 2.0, "bias": 0.2}
N_PROBES = 8
N_LOGGED = {"full": [100, 400], "quick": [100]}
N_HELD_OUT = {"full": 200, "quick": 100}
N_EVALUATIONS = {"full": 2000, "quick": 500}
#: Starts over which returns are averaged: of held-out policies, in a search, of a proposal
N_STARTS = {"assess": 5, "search": 10, "proposal": 50}
# a trajectory model gives the reward of every fifth step: falls are sudden
EVERY = 5
# a length scale for each of 35 inputs takes longer to settle than the default waits
_GP_ITERATIONS = 400
# logged policies that a search begins with
_N_BEGIN = 5
#: Horizons over which errors are averaged.
WINDOWS = {
    "1 to 10": (1, 10),
    "11 to 25": (11, 25),
    "26 to 100": (26, 100),
    "101 to 200": (101, 200),
}


class Kind(NamedTuple):
    """What a model is, and whether it sees what the network answers at the probe states."""

    model: str
    responses: bool = False


#: "simulator" is no model: what a search finds with the truth.
MODELS = {
    "T, weights": Kind("T"),
    "T, responses": Kind("T", responses=True),
    "D, policy": Kind("D"),
    "GP, weights": Kind("GP"),
    "GP, responses": Kind("GP", responses=True),
    "constant": Kind("constant"),
    "simulator": Kind("simulator"),
}


def shown(model: str) -> str:
    """Name of a row in text and figures, which say what is found on it."""
    return {"constant": "best logged network", "simulator": "simulator itself"}.get(model, model)


def bounds() -> Floats:
    """Range of the weights (31, 2): what enters the hidden units is of order one."""
    hidden = POLICY.hidden[0]
    half = np.concatenate(
        [
            np.tile(WIDTHS["input"] / np.array(INPUT_SCALE), hidden),
            np.full(hidden, WIDTHS["bias"]),
            np.full(hidden, WIDTHS["output"]),
            [WIDTHS["bias"]],
        ]
    )
    return np.stack([-half, half], axis=1)


@lru_cache(maxsize=4)
def flown(n: int, *seed: int, scaled: bool = True) -> TrajectoryDataset:
    """Episodes of n networks at random, each from a start of its own; kept when they fall.

    Not `scaled`, weights are drawn from U[-1, 1].
    """
    rng = np.random.default_rng(seed)
    box = bounds() if scaled else np.tile([-1.0, 1.0], (POLICY.n_params, 1))
    weights = rng.uniform(box[:, 0], box[:, 1], size=(n, POLICY.n_params))
    return TASK.env.rollout(TASK.starts(n, rng), weights, LENGTH, POLICY)


def true_returns(weights: Floats, starts: Floats) -> Floats:
    """Mean return per step of networks (m, 31) over the starts (n0, 4), in the simulator (m,)."""
    at = np.tile(starts, (len(weights), 1))
    episodes = TASK.env.rollout(at, np.repeat(weights, len(starts), axis=0), LENGTH, POLICY)
    return TASK.returns(episodes).reshape(len(weights), len(starts)).mean(axis=1)


def probes(log: TrajectoryDataset) -> Floats:
    """Logged states far from one another (k, 4): centres of k-means on standardised states."""
    scale = log.states.std(axis=0)
    found = KMeans(N_PROBES, n_init=3, random_state=0).fit(log.states / scale)
    return np.asarray(found.cluster_centers_ * scale)


def make(kind: Kind, log: TrajectoryDataset, mode: str, seed: int) -> Any:
    """The model, fitted on a log."""
    if kind.model == "GP":
        estimator: Any = DirectRewardGP(
            reward=TASK.reward,
            horizon=LENGTH,
            terminal_reward=TASK.terminal_reward,
            random_state=seed,
        ).set_params(estimator__max_iter=_GP_ITERATIONS)
    else:
        estimator = build(kind.model, "default", policy=POLICY, mode=mode, seed=seed)
    if kind.responses:
        described = partial(POLICY.responses, probe_states=probes(log))
        estimator = make_pipeline(ParamsTransformer(described), estimator)
    return estimator.fit(log)


def predicted(model: Any, kind: Kind, starts: Floats) -> PredictedReturn:
    """Return of networks that a model predicts, the sum over a trial."""
    return PredictedReturn(
        model,
        reward=TASK.reward,
        horizon=LENGTH,
        dt=TASK.env.dt,
        initial_states=starts,
        is_terminal=TASK.is_terminal,
        terminal_reward=TASK.terminal_reward,
        every=EVERY if kind.model == "T" else 1,
    )


def cell(model: str, n: int, mode: str, seed: int) -> dict[str, Any]:
    """Fit one model on n logged episodes; returns of held-out networks, errors, a search."""
    kind, log, held_out = MODELS[model], flown(n, seed, 0), flown(N_HELD_OUT[mode], seed, 1)
    weights = np.asarray(held_out.params)
    at = {use: TASK.common_starts[:k] for use, k in N_STARTS.items()}
    truth = true_returns(weights, at["assess"])
    logged = TASK.returns(log)
    first = np.asarray(log.params)[np.argsort(-logged)[:_N_BEGIN]]
    if kind.model == "constant":
        best = float(true_returns(first[:1], at["proposal"])[0])
        found: dict[str, Any] = {"true": best, "predicted": float(logged.max())}
        for name, some in (("stood", log), ("stood_unscaled", flown(n, seed, 0, scaled=False))):
            found[name] = float(np.mean(some.lengths == LENGTH))
        return _scores(np.full(len(truth), logged.mean()), truth) | {"search": found}
    began = time.perf_counter()
    fitted = None if kind.model == "simulator" else make(kind, log, mode, seed)
    seconds = {"fit": time.perf_counter() - began}
    # the states that proposals are made for are not those that they are scored on
    search_starts = TASK.starts(N_STARTS["search"], np.random.default_rng([seed, 2]))

    def value(candidates: Floats) -> Floats:
        if fitted is None:
            return true_returns(candidates, search_starts)
        return predicted(fitted, kind, search_starts)(candidates).value / LENGTH

    began = time.perf_counter()
    with expected_warnings():
        best_found = maximise(
            value,
            bounds(),
            method="cma",
            n_evaluations=N_EVALUATIONS[mode],
            rng=np.random.default_rng([seed, 3]),
            start=first,
        )
    seconds["search"] = time.perf_counter() - began
    proposal = best_found.params[None]
    search = {
        "true": float(true_returns(proposal, at["proposal"])[0]),
        "predicted": best_found.value,
    }
    result: dict[str, Any] = {"search": search, "seconds": seconds}
    if fitted is None:
        return result
    with expected_warnings():
        guess = predicted(fitted, kind, at["assess"])(weights).value / LENGTH
    result |= _scores(guess, truth)
    if kind.model != "GP":
        result["errors"] = _errors(fitted, held_out)
    return result


def _scores(guess: Floats, truth: Floats) -> dict[str, Any]:
    """Squared error and ranks of predicted returns per step, and both for a figure."""
    varied = np.ptp(guess) > 0
    return {
        "mse": float(np.mean((guess - truth) ** 2)),
        "rank": float(spearmanr(guess, truth).statistic) if varied else float("nan"),
        "returns": {"predicted": guess, "true": truth},
    }


def _errors(model: Any, test: TrajectoryDataset) -> dict[str, Any]:
    """Median and 95th percentile over test episodes of the mean squared error in each window.

    An episode counts in the windows that it reaches, up to its end.
    """
    with expected_warnings():
        errors = horizon_errors(model.predict(test), test, truth_kind="true").to_numpy()
    lines: dict[str, list[Any]] = {"window": [], "median": [], "q95": [], "episodes": []}
    for name, (low, high) in WINDOWS.items():
        some = errors[~np.isnan(errors[:, low - 1]), low - 1 : high]
        means = np.nanmean(some, axis=1)
        lines["window"].append(name)
        lines["median"].append(np.median(means))
        lines["q95"].append(np.quantile(means, 0.95))
        lines["episodes"].append(len(means))
    return lines
