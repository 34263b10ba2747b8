"""The paper's protocol taken apart: one cell for each of its choices that changes a conclusion.

Nothing here is a way to work; every function reproduces a defect or a handicap of the published
experiments beside the same thing done right, so that its effect is a number:

- actions one step late: the code logs a_t with s_{t+1}, and learns (s_{t+1}, a_t) -> s_{t+2};
- a reward table computed on training episodes;
- an N x N difference of predicted and true rewards for GP and NN;
- a direct network that is hardly trained;
- fewer episodes and a lower learning rate for the one-step model than for the trajectory model;
- on the reacher, recomputed actions with a fifth of the proportional gain.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._models import QUICK_EPOCHS, build
from benchmarks.paper._rollouts import N_TEST, assess
from benchmarks.paper._tasks import N_EPISODES, TASKS, environment, episodes
from trajlearn import DirectRewardNN, TrajectoryDataset, paper
from trajlearn.exceptions import DivergenceWarning

#: Share of the training episodes that the paper's GP is fitted to before it is scored on all.
GP_SHARE = 0.8
#: Learning rate of the direct network in the paper's code.
NN_RATE = 3e-5
#: Gradient steps at which it is looked at; the paper's code takes about as many as the first.
NN_STEPS = {"full": (30, 100, 1000, 10_000), "quick": (30, 300)}


def late(ds: TrajectoryDataset) -> TrajectoryDataset:
    """The episodes as the paper's code logs them: state i is s_{i+1}, action i is a_i."""
    return TrajectoryDataset.from_arrays(
        [episode.states[1:] for episode in ds],
        actions=[episode.actions[:-1] for episode in ds],
        params=ds.params,
        times=[episode.times[1:] for episode in ds],
        **ds.names,
    )


def all_pairs_error(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Mean squared difference of every estimate and every truth, as (N, 1) - (N,) gives it."""
    return float(((estimate[:, None] - truth) ** 2).mean())


def rewards(ds: TrajectoryDataset, reward: Callable[..., Any]) -> NDArray[np.float64]:
    """Mean reward per step of each episode."""
    return np.array([reward(episode.states[1:]).mean() for episode in ds])


# -- cells ---------------------------------------------------------------------------------------


def reward_cell(task: str, method: str, mode: str, seed: int) -> dict[str, Any]:
    """Predicted and true rewards of training and test episodes, the paper's settings.

    `method` is GP, NN, T, D (aligned) or "D late"; on the reacher also "D weak" and "D late
    weak", whose recomputed actions are those of a controller with a fifth of its proportional gain.
    """
    env = environment(task)
    train, test = episodes(task, seed, n_test=N_TEST[mode])
    if "late" in method:
        train, test = late(train), late(test)
    fitted_to = train[: int(GP_SHARE * len(train))] if method == "GP" else train
    model = _reward_model(task, method, mode, seed).fit(fitted_to)
    sources = ["policy"] if "weak" in method else ["logged", "policy"]
    result: dict[str, Any] = {}
    for name, ds in (("train", train), ("test", test)):
        truth = rewards(ds, env.reward)
        for actions in sources if method.startswith("D") else ["none"]:
            estimate = _reward_estimate(model, ds, env.reward, actions)
            result[f"{name}, {actions}"] = {"truth": truth, "estimate": estimate}
    return result


def _reward_model(task: str, method: str, mode: str, seed: int) -> Any:
    env = environment(task)
    if method == "GP":
        return paper.model("GP", reward=env.reward, random_state=seed)
    if method == "NN":
        return _hardly_trained(min(NN_STEPS[mode]), env.reward, seed)
    policy = dataclasses.replace(env.policy, p_scale=1.0) if "weak" in method else env.policy
    return build(method[0], "paper", policy=policy, mode=mode, seed=seed)


def _reward_estimate(
    model: Any, ds: TrajectoryDataset, reward: Any, actions: str
) -> NDArray[np.float64]:
    if not hasattr(model, "predict_reward"):
        return model.predict(ds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        asked = {} if actions == "none" else {"actions": actions}
        return model.predict_reward(ds, reward, **asked)


def late_cell(task: str, settings: str, mode: str, seed: int) -> dict[str, Any]:
    """D trained and asked with late actions: errors by window, as of an aligned one."""
    env, (length, test_length) = environment(task), TASKS[task]
    train, test = episodes(task, seed, n_test=N_TEST[mode], test_length=test_length)
    model = build("D", settings, policy=env.policy, mode=mode, seed=seed).fit(late(train))
    return {
        actions: assess(model, late(test), length=length - 1, actions=actions)["windows"]
        for actions in ("logged", "policy")
    }


def budget_cell(
    task: str, model: str, n_train: int, steps: int, budget: str, mode: str, seed: int
) -> dict[str, Any]:
    """D or T on training episodes of some steps; D also with T's learning rate and steps.

    `budget` is "own" (the paper's settings of the model) or "of T".
    """
    env, length = environment(task), TASKS[task].length
    _, test = episodes(task, seed, n_test=N_TEST[mode])
    # an episode begins the same whatever its length: the first n of the usual ones
    train = env.collect(n_train, steps, random_state=2 * seed)
    estimator = build(model, "paper", policy=env.policy, mode=mode, seed=seed)
    if budget == "of T":
        pattern = paper.model("T").get_params()
        epochs = pattern["estimator__max_epochs"] if mode == "full" else QUICK_EPOCHS["T"]
        batch = pattern["estimator__batch_size"]
        estimator.set_params(
            estimator__learning_rate=pattern["estimator__learning_rate"],
            estimator__batch_size=batch,
            estimator__max_epochs=None,
            estimator__max_steps=epochs * pattern["relabeler__max_rows"] // batch,
        )
    estimator.fit(train)
    sources = ["none"] if model == "T" else ["logged", "policy"]
    return {
        actions: assess(
            estimator, test, length=length, **({} if actions == "none" else {"actions": actions})
        )["windows"]
        for actions in sources
    }


def untrained_cell(task: str, steps: int, mode: str, seed: int) -> dict[str, Any]:
    """The direct network after some gradient steps at the paper's rate; 0: our defaults."""
    env = environment(task)
    train, test = episodes(task, seed, n_test=N_TEST[mode])
    if steps:
        model = _hardly_trained(steps, env.reward, seed)
    else:
        model = DirectRewardNN(reward=env.reward, random_state=seed)
    model.fit(train)
    return {
        name: {"truth": rewards(ds, env.reward), "estimate": model.predict(ds)}
        for name, ds in (("train", train), ("test", test))
    }


def _hardly_trained(steps: int, reward: Any, seed: int) -> Any:
    """The direct network at the learning rate of the paper's code."""
    model = paper.model("NN", reward=reward, random_state=seed)
    return model.set_params(
        estimator__learning_rate=NN_RATE,
        estimator__max_epochs=None,
        estimator__max_steps=steps,
    )


def planning_cell(candidates: int, mode: str, seed: int) -> dict[str, float]:
    """Seconds for whole trajectories of many candidates, by bare networks of the paper's size.

    Nothing of this library is timed: plain torch on one thread, 200 steps of cartpole. T at all
    horizons and at every tenth, with the first layer split and in cache-sized pieces; a one-step
    model rolled out with the linear controller. Rounds alternate; median seconds.
    """
    import torch

    generator = torch.Generator().manual_seed(seed)
    steps, d_s, p = TASKS["cartpole"].length, 4, 4

    def network(n_in: int) -> torch.nn.Sequential:
        layers: list[torch.nn.Module] = []
        for a, b in ((n_in, 250), (250, 250)):
            layers += [torch.nn.Linear(a, b), torch.nn.ReLU()]
        return torch.nn.Sequential(*layers, torch.nn.Linear(250, d_s))

    jump, step = network(d_s + 1 + p), network(d_s + 1)
    states = torch.rand(candidates, d_s, generator=generator)
    gains = torch.rand(candidates, p, generator=generator)

    first, *rest = jump
    rest = torch.nn.Sequential(*rest)

    def trajectories(horizons: torch.Tensor) -> None:
        # the first layer's products with starts and with horizons are computed apart
        ahead = horizons[:, None] * first.weight[:, d_s]
        weight = torch.cat([first.weight[:, :d_s], first.weight[:, d_s + 1 :]], 1)
        starts = torch.addmm(first.bias, torch.cat([states, gains], 1), weight.T)
        piece = max(2000 // len(horizons), 1)  # candidates at once whose rows fit a cache
        for some in starts.split(piece):
            rest((some[:, None] + ahead).flatten(0, 1))

    def roll_out() -> None:
        now = states
        for _ in range(steps):
            action = -(gains * now).sum(1, keepdim=True).clip(-1, 1)
            now = now + 1e-3 * step(torch.cat([now, action], 1))

    every, tenth = torch.arange(1.0, steps + 1), torch.arange(10.0, steps + 1, 10)
    ways = {
        "T": lambda: trajectories(every),
        "T, every 10th horizon": lambda: trajectories(tenth),
        "one-step": roll_out,
    }
    rounds = {"full": 15, "quick": 3}[mode]
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    with torch.inference_mode():
        for _ in range(rounds + 1):
            for name, way in ways.items():
                began = time.perf_counter()
                way()
                seconds[name].append(time.perf_counter() - began)
    return {name: float(np.median(taken[1:])) for name, taken in seconds.items()}


def plan(mode: str, seeds: list[int]) -> dict[Callable[..., Any], list[dict[str, Any]]]:
    """All cells of a run, by function."""
    both = list(TASKS)
    base = [{"mode": mode, "seed": seed} for seed in seeds]
    methods = {"cartpole": ["GP", "NN", "D", "D late", "T"]}
    methods["reacher"] = [*methods["cartpole"], "D weak", "D late weak"]
    # the paper's code: the same number of transitions, in half the episodes
    usual, long = TASKS["reacher"]
    budgets = [("D", N_EPISODES // 2, long, "own"), ("D", N_EPISODES, usual, "own")]
    budgets += [("D", N_EPISODES, usual, "of T"), ("T", N_EPISODES, usual, "own")]
    return {
        reward_cell: [
            {"task": task, "method": method} | b
            for b in base
            for task in both
            for method in methods[task]
        ],
        late_cell: [
            {"task": task, "settings": kind} | b
            for b in base
            for task in both
            for kind in ("paper", "default")
        ],
        budget_cell: [
            {"task": "reacher", "model": model, "n_train": n, "steps": steps, "budget": budget} | b
            for b in base
            for model, n, steps, budget in budgets
        ],
        untrained_cell: [
            {"task": task, "steps": steps} | b
            for b in base
            for task in both
            for steps in (*NN_STEPS[mode], 0)
        ],
        planning_cell: [{"candidates": n} | b for b in base for n in (1, 10, 100, 1000)],
    }
