"""Methods of iterative learning by name, and one repeat of one of them."""

import time
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression

from benchmarks.paper._control_tasks import CONTROL_TASKS, ControlTask
from trajlearn import (
    BayesianSearch,
    BlockScaler,
    DirectRewardGP,
    DistilledForecaster,
    HorizonFeatures,
    MLPEnsembleRegressor,
    OneStepRegressor,
    PolicySearch,
    RandomSearch,
    SubtrajectoryRelabeler,
    TrajectoryRegressor,
    paper,
)
from trajlearn.exceptions import DivergenceWarning

Floats = NDArray[np.float64]

DISTILLED, GRADIENTS = "T, distilled", "T, distilled, by gradients"
LINEAR = "D, linear"
BO, RANDOM = "Bayesian optimisation", "random"
#: A usual way to begin Bayesian optimisation, which else tries the corners of the box first.
BO_LATER, N_SOBOL = "Bayesian optimisation, 5 Sobol points first", 5
#: What is compared, in the order in which it is shown, and what each learns from.
METHODS = {
    DISTILLED: "T, from the trials and from what a one-step model imagines; CMA-ES on the mean "
    "return of sampled trajectories",
    GRADIENTS: "the same T; gradient ascent on the return of its mean trajectory",
    "T": "T, from the trials alone; CMA-ES",
    "T, paper's settings": "the same, with the paper's network and scaling, which give no "
    "variance; CMA-ES on the return of its mean trajectory",
    "D": "one-step network, actions recomputed; CMA-ES",
    LINEAR: "one-step linear regression, actions recomputed; CMA-ES",
    "direct GP": "Gaussian process from (s_0, theta) to the return; CMA-ES on its mean",
    BO: "Gaussian process from theta to the return; log expected improvement",
    BO_LATER: "the same after four more Sobol points, those of random",
    RANDOM: "Sobol points",
}
#: Methods that plan with a trajectory model.
TRAJECTORY = [DISTILLED, GRADIENTS, "T", "T, paper's settings"]
#: Methods of a task: a reacher is not linear.
OF_TASK = {
    "cartpole": list(METHODS),
    "reacher": [method for method in METHODS if method != LINEAR],
}
#: What imagines for T: the one-step model that is best on the task.
TEACHER = {"cartpole": LINEAR, "reacher": "D"}

#: By mode: gradient steps of networks, imagined episodes, epochs of the paper's T, evaluations of
#: a model by CMA-ES and by gradients, trials of a repeat by task.
SIZES: dict[str, dict[str, Any]] = {
    "full": {
        "steps": 1000,
        "imagined": {"cartpole": 1000, "reacher": 500},
        "paper_epochs": 8,
        "evaluations": {"cartpole": 200, "reacher": 400},
        "by_gradients": 640,
        "trials": {"cartpole": 10, "reacher": 8},
    },
    "quick": {
        "steps": 300,
        "imagined": {"cartpole": 200, "reacher": 50},
        "paper_epochs": 1,
        "evaluations": {"cartpole": 60, "reacher": 60},
        "by_gradients": 120,
        "trials": {"cartpole": 4, "reacher": 3},
    },
}
#: Hidden layers of the network of T.
WIDTHS = (128, 128)
#: Sub-trajectories that the paper's T is fitted on at most; its code keeps 5 % of them.
PAPER_ROWS = 8000
#: The reward is read off T's predictions at each k-th step.
EVERY = {"cartpole": 5, "reacher": 10}
#: Initial states that a candidate is judged from: fresh resets, as in the paper's code. The
#: reacher's are within 0.01 of one another.
N_PLANNED = {"cartpole": 20, "reacher": 2}
#: Trajectories sampled from T for each of them: a mean trajectory looks calm where nobody knows
#: to which side the pole falls.
N_SAMPLES = 5
#: Roll-outs, and imagined states, stay within this multiple of the range of the trials.
CLIP = 3.0


def learner(method: str, task: ControlTask, mode: str, planned: Floats) -> Any:
    """The model that a method plans with; one that imagines begins where it plans."""
    steps = SIZES[mode]["steps"]
    if method in ("D", LINEAR):
        network = MLPEnsembleRegressor(n_members=1, max_steps=steps)
        one_step = LinearRegression() if method == LINEAR else network
        return OneStepRegressor(one_step, policy=task.env.policy, clip_states=CLIP)
    if method in (DISTILLED, GRADIENTS):
        student = _trajectories(task, steps, starts="first")
        return DistilledForecaster(
            learner(TEACHER[task.name], task, mode, planned),
            student,
            param_bounds=task.bounds,
            initial_states=planned,
            horizon=task.length,
            n_imagined=SIZES[mode]["imagined"][task.name],
            reach=CLIP,
        )
    if method == "T":
        return _trajectories(task, steps, starts="uniform")
    if method == "T, paper's settings":
        epochs = SIZES[mode]["paper_epochs"]
        return paper.model("T", relabeler__max_rows=PAPER_ROWS, estimator__max_epochs=epochs)
    if method == "direct GP":
        return DirectRewardGP()
    raise ValueError(f"{method!r} plans with no model.")


def _trajectories(task: ControlTask, steps: int, *, starts: str) -> TrajectoryRegressor:
    """T with a trained variance; theta scaled by the bounds of the search, not by the trials."""
    return TrajectoryRegressor(
        MLPEnsembleRegressor(hidden_layer_sizes=WIDTHS, probabilistic=True, max_steps=steps),
        relabeler=SubtrajectoryRelabeler(starts=starts, horizons="mixture"),
        scaler=BlockScaler(horizon=HorizonFeatures(), param_bounds=task.bounds),
    )


def search(method: str, task: ControlTask, mode: str, repeat: int, planned: Floats) -> Any:
    """The search of a method; all of one repeat begin with the same Sobol point."""
    shared = {
        "bounds": task.bounds,
        "reward": task.reward,
        "horizon": task.length,
        "terminal_reward": task.terminal_reward,
        "random_state": repeat,
    }
    if method == RANDOM:
        return RandomSearch(**shared)
    if method in (BO, BO_LATER):
        return BayesianSearch(**shared, n_initial=N_SOBOL if method == BO_LATER else 1)
    by_gradients, sampled = method == GRADIENTS, method in (DISTILLED, "T")
    sizes = SIZES[mode]
    budget = sizes["by_gradients"] if by_gradients else sizes["evaluations"][task.name]
    return PolicySearch(
        learner(method, task, mode, planned),
        **shared,
        initial_states=planned,
        optimizer="gradient" if by_gradients else "cma",
        objective="expected" if sampled else "mean",
        n_samples=N_SAMPLES,
        n_evaluations=budget,
        is_terminal=task.is_terminal,
        every=EVERY[task.name] if method in TRAJECTORY else 1,
    )


def proposal(search: Any, task: ControlTask, *, first: bool) -> tuple[Floats, float, float]:
    """What to try next, and the seconds of fitting the model (and asking it once) and of searching.

    Bayesian optimisation does both as one; all of it counts as searching.
    """
    began = time.process_time()
    if isinstance(search, PolicySearch) and not first:
        search.predict_return(task.bounds.mean(axis=1)[None])  # fits, once
    fitted = time.process_time()
    params = search.ask()
    return params, fitted - began, time.process_time() - fitted


def repeat(task: str, method: str, repeat: int, mode: str) -> list[dict[str, Any]]:
    """A cell: trials of one method, from the same starts for every method.

    Returns are per step: `seen` of the trial, `true` of its theta over the common test starts.
    """
    what = CONTROL_TASKS[task]
    draw = np.random.default_rng([repeat, 6])
    starts = what.starts(SIZES[mode]["trials"][task], draw)
    tuned = search(method, what, mode, repeat, what.starts(N_PLANNED[task], draw))
    lines = []
    for k, start in enumerate(starts):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DivergenceWarning)
            params, fit, rest = proposal(tuned, what, first=k == 0)
        trial = what.env.rollout(start[None], params, what.length)
        tuned.tell(trial)
        lines.append(
            {
                "method": method,
                "repeat": repeat,
                "trial": k + 1,
                "seen": what.returns(trial)[0],
                "true": what.true_return(params[None])[0],
                "steps": trial[0].length,
                "seconds_fit": fit,
                "seconds_search": rest,
            }
        )
    return lines
