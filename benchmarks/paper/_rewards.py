"""One model of the reward table on one seed: choose a configuration, fit, predict rewards."""

import time
import warnings
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._reward_models import Config, candidates, for_prediction, for_training, make
from benchmarks.paper._tasks import environment, episodes
from trajlearn import Reacher, TrajectoryDataset
from trajlearn.evaluation import reward_errors
from trajlearn.exceptions import DivergenceWarning

Floats = NDArray[np.float64]

#: A roll-out that is farther outside the training states than this many of their ranges is lost.
FAR = 10.0


class Predicted(NamedTuple):
    """Mean reward per step of each episode, and what tells whether to believe it.

    `rewards` and `own` (the reward with a goal of the episode's own) are -inf where the forecast
    diverged; `far` counts the episodes whose forecast is lost, see `FAR`.
    """

    rewards: Floats
    own: Floats | None = None
    far: int | None = None


@lru_cache(maxsize=3)
def flown(task: str, seed: int) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Training and test episodes, simulated once for all cells of a process."""
    return episodes(task, seed)


def rows(model: str) -> dict[str, str | None]:
    """Rows of the table that one fitted model gives, with the actions of each."""
    if model.startswith("D"):
        return {f"{model}, logged actions": "logged", f"{model}, predicted actions": "policy"}
    return {model: None}


def states_of(ds: TrajectoryDataset) -> Floats:
    """States that the steps lead into (n, T, d_s), of episodes of one length."""
    return np.stack([episode.states[1:] for episode in ds])


def own_goals(n: int, seed: int) -> Floats:
    """A goal for each of n episodes (n, 3), as the paper draws them."""
    return np.random.default_rng([seed, 3]).uniform(-0.5, 0.5, size=(n, 3))


def own_rewards(states: Floats, goals: Floats) -> Floats:
    """Mean of the reacher's reward along paths (n, T, d_s) with goals (n, 3)."""
    return -np.linalg.norm(Reacher().fingertip(states) - goals[:, None], axis=-1).mean(axis=1)


def predict(
    model: Any, ds: TrajectoryDataset, reward: Any, actions: str | None, goals: Floats | None
) -> Predicted:
    """Rewards that a fitted model predicts; `goals` are for models that predict states."""
    if not hasattr(model, "predict_reward"):
        return Predicted(model.predict(ds))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        forecast = model.predict(ds, **({} if actions is None else {"actions": actions}))
    diverged = forecast.diverged_at > 0
    states = np.where(diverged[:, None, None], 0.0, forecast.mean)
    low, high = forecast.state_range
    outside = np.maximum(low - forecast.mean, forecast.mean - high) / np.maximum(high - low, 1e-12)
    return Predicted(
        np.where(diverged, -np.inf, reward(states).mean(axis=1)),
        None if goals is None else np.where(diverged, -np.inf, own_rewards(states, goals)),
        int((outside > FAR).any(axis=(1, 2)).sum()),
    )


def constant(train: TrajectoryDataset, n: int, reward: Any, goals: Floats | None) -> Predicted:
    """What one expects of n episodes without looking at s_0 and theta, for the goal at hand."""
    states = states_of(train)
    own = None
    if goals is not None:
        own = np.array([own_rewards(states, goal[None]).mean() for goal in goals])
    return Predicted(np.full(n, reward(states).mean()), own)


def cell(task: str, model: str, settings: str, mode: str, seed: int) -> list[dict[str, Any]]:
    """Fit one model on one seed; one record a row of the table."""
    reward = environment(task).reward
    train, test = flown(task, seed)
    goals = own_goals(len(test), seed) if task == "reacher" else None
    states = states_of(test)
    truth = Predicted(
        reward(states).mean(axis=1), None if goals is None else own_rewards(states, goals)
    )
    if model == "constant":
        shown = constant(train, len(test), reward, goals)
        return [record(settings, model, seed, truth, shown, 0.0, {})]
    chosen, tuning = choose(task, model, settings, mode, seed, train)
    fitted: dict[str, tuple[Any, float]] = {}
    records = []
    for row, actions in rows(model).items():
        config = chosen[row]
        if str(config) not in fitted:
            began = time.process_time()
            estimator = make(task, model, settings, config, mode, seed)
            estimator.fit(for_training(task, train, model, config))
            fitted[str(config)] = estimator, time.process_time() - began
        estimator, seconds = fitted[str(config)]
        shown = predict(
            estimator, for_prediction(task, test, model, config), reward, actions, goals
        )
        records.append(record(settings, row, seed, truth, shown, tuning + seconds, config))
    return records


def choose(
    task: str, model: str, settings: str, mode: str, seed: int, train: TrajectoryDataset
) -> tuple[dict[str, Config], float]:
    """Configuration of each row, and the seconds that choosing took.

    Tuned: the candidate with the least squared reward error on a fifth of the training
    episodes, held out.
    """
    if settings != "tuned":
        return {row: {} for row in rows(model)}, 0.0
    began = time.process_time()
    reward = environment(task).reward
    order = np.random.default_rng(seed).permutation(len(train))
    held, kept = train[order[: len(train) // 5]], train[order[len(train) // 5 :]]
    truth = reward(states_of(held)).mean(axis=1)
    tried = candidates(task, model)
    scores: dict[str, list[float]] = {row: [] for row in rows(model)}
    for config in tried:
        estimator = make(task, model, settings, config, mode, seed)
        estimator.fit(for_training(task, kept, model, config))
        shown = for_prediction(task, held, model, config)
        for row, actions in rows(model).items():
            guess = predict(estimator, shown, reward, actions, None).rewards
            scores[row].append(float(np.mean((guess - truth) ** 2)))
    best = {row: tried[int(np.nanargmin(scores[row]))] for row in scores}
    return best, time.process_time() - began


def record(
    settings: str,
    row: str,
    seed: int,
    truth: Predicted,
    predicted: Predicted,
    seconds: float,
    config: Config,
) -> dict[str, Any]:
    """One line of the raw results."""
    errors = reward_errors(predicted.rewards, truth.rewards)
    signed = predicted.rewards - truth.rewards
    own = None
    if predicted.own is not None and truth.own is not None:
        own = reward_errors(predicted.own, truth.own)["mean"]
    return {
        "settings": settings,
        "row": row,
        "seed": seed,
        "n_episodes": errors["n_episodes"],
        "mean": errors["mean"],
        "std": errors["std"],
        "median": errors["median"],
        "signed_std": float(np.std(signed)) if np.isfinite(signed).all() else np.inf,
        "own_goal": own,
        "n_diverged": errors["n_diverged"],
        "n_far": predicted.far,
        "seconds": seconds,
        "config": config,
    }
