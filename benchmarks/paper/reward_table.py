"""Table I: predicting the reward of an episode from its first state and the controller.

Rows with the paper's settings, then tuned, then with the library's defaults; the closed-loop
one-step model C and a constant beside them. 100 training and 100 test episodes that share no
seed. Every tuned row tries the same number of configurations on a fifth of the training
episodes held out, and is fitted anew on all of them.
"""

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks._results import provenance, write_json
from benchmarks._sweep import run_cells
from trajlearn import (
    Cartpole,
    DirectRewardGP,
    DirectRewardNN,
    OneStepRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
    paper,
)
from trajlearn.evaluation import reward_errors
from trajlearn.exceptions import DivergenceWarning

RESULTS = Path(__file__).parent / "results" / "reward-table"

N_EPISODES = 100
LENGTH = {"cartpole": 200}
# gradient steps of a network, full and quick
MAX_STEPS = {"full": 4000, "quick": 1500}
PAPER_EPOCHS = {"full": {}, "quick": {"T": 2, "D": 6}}

# the figures that the paper prints: mean squared error and the std beside it
PAPER = {
    "cartpole": {
        "GP": (0.884, 1.873),
        "NN": (0.446, 1.189),
        "D, logged actions": (0.057, 0.100),
        "D, predicted actions": (0.979, 1.725),
        "T": (0.010, 0.033),
    },
}
MAPPING = {
    "GP": "(s_0, theta) -> R",
    "NN": "(s_0, theta) -> R",
    "D, logged actions": "(s_0, a_0 ... a_L) -> R",
    "D, predicted actions": "(s_0, theta, policy) -> R",
    "C": "(s_0, theta) -> R",
    "T": "(s_0, theta) -> R",
    "constant": "mean training reward",
}


def environment(task: str) -> Any:
    """The task's simulator; like the paper it redraws episodes that end early."""
    return {"cartpole": Cartpole}[task](redraw_terminated=True)


def episodes(task: str, seed: int) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """Training and test episodes; their seeds never meet."""
    env = environment(task)
    train = env.collect(N_EPISODES, LENGTH[task], random_state=2 * seed)
    return train, env.collect(N_EPISODES, LENGTH[task], random_state=2 * seed + 1)


def mirrored(ds: TrajectoryDataset) -> TrajectoryDataset:
    """The episodes and their mirror images: cartpole under linear feedback is odd in the state."""
    return _flipped(ds, np.ones(len(ds))).concatenate(_flipped(ds, -np.ones(len(ds))))


def folded(ds: TrajectoryDataset) -> TrajectoryDataset:
    """Each episode or its mirror image, whichever begins with the pole to the right.

    For direct reward models. Both images together would mislead a Gaussian process: they share
    theta and reward, so that noise-free interpolation over theta alone explains the data best.
    """
    return _flipped(ds, np.array([np.sign(episode.states[0, 2]) or 1.0 for episode in ds]))


def _flipped(ds: TrajectoryDataset, signs: np.ndarray) -> TrajectoryDataset:
    return TrajectoryDataset.from_arrays(
        [sign * episode.states for sign, episode in zip(signs, ds, strict=True)],
        actions=[sign * episode.actions for sign, episode in zip(signs, ds, strict=True)],
        params=ds.params,
        times=[episode.times for episode in ds],
        **ds.names,
    )


# -- models ---------------------------------------------------------------------------------------

Config = dict[str, Any]


def build(task: str, family: str, config: Config, mode: str, seed: int) -> Any:
    """Estimator of a family with a configuration (None: the library's defaults)."""
    env = environment(task)
    steps = {"estimator__max_steps": MAX_STEPS[mode]}
    settings = {key: value for key, value in config.items() if key != "symmetry"}
    if family == "GP":
        return DirectRewardGP(reward=env.reward, random_state=seed).set_params(**settings)
    if family == "NN":
        return DirectRewardNN(reward=env.reward, random_state=seed).set_params(**settings)
    if family == "D":
        model = OneStepRegressor(policy=env.policy, random_state=seed)
    elif family == "C":
        model = OneStepRegressor(inputs="params", random_state=seed)
    else:
        model = TrajectoryRegressor(random_state=seed)
    return model.set_params(**steps | settings)


CANDIDATES: dict[str, list[Config]] = {
    "GP": [{"estimator__kernel": kernel} for kernel in ("rbf", "matern52")],
    "NN": [{"estimator__weight_decay": decay} for decay in (1e-2, 1e-1)],
    "D": [{"estimator__batch_size": size} for size in (128, 256)],
    "C": [{"estimator__batch_size": size} for size in (128, 256)],
    "T": [{"gate": gate} for gate in (0.05, 0.2)],
}


def candidates(task: str, family: str) -> list[Config]:
    """Four configurations for every family: two settings, with and without the symmetry."""
    return [
        config | {"symmetry": symmetry}
        for symmetry in (False, True)
        for config in CANDIDATES[family]
    ]


def for_training(ds: TrajectoryDataset, family: str, config: Config) -> TrajectoryDataset:
    """Training episodes as a configuration wants them."""
    if not config.get("symmetry"):
        return ds
    return folded(ds) if family in ("GP", "NN") else mirrored(ds)


def for_prediction(ds: TrajectoryDataset, family: str, config: Config) -> TrajectoryDataset:
    """Episodes to predict as a configuration wants them."""
    return folded(ds) if config.get("symmetry") and family in ("GP", "NN") else ds


# -- cells ----------------------------------------------------------------------------------------


def predicted(model: Any, ds: TrajectoryDataset, reward: Any, actions: str | None) -> np.ndarray:
    """Mean reward per step that a model predicts for each episode."""
    if not hasattr(model, "predict_reward"):
        return model.predict(ds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        return model.predict_reward(ds, reward, **({} if actions is None else {"actions": actions}))


def true_rewards(ds: TrajectoryDataset, reward: Any) -> np.ndarray:
    """Mean reward per step of each episode."""
    return np.array([reward(episode.states[1:]).mean() for episode in ds])


def variants(family: str) -> dict[str, str | None]:
    """Rows of the table that one fitted model gives, with the actions of each."""
    if family == "D":
        return {"D, logged actions": "logged", "D, predicted actions": "policy"}
    return {family: None}


def cell(task: str, settings: str, family: str, mode: str, seed: int) -> list[dict[str, Any]]:
    """Fit one family on one seed; one record a row of the table."""
    env = environment(task)
    train, test = episodes(task, seed)
    truth = true_rewards(test, env.reward)
    rows: list[dict[str, Any]] = []
    if family == "constant":
        estimate = np.full(len(test), true_rewards(train, env.reward).mean())
        return [record(settings, "constant", seed, truth, estimate, 0.0, {})]
    chosen, tuning = chosen_configs(task, settings, family, mode, seed, train, env.reward)
    models: dict[str, tuple[Any, float]] = {}
    for row, actions in variants(family).items():
        key = str(chosen[row])
        if key not in models:
            began = time.perf_counter()
            model = make(task, settings, family, chosen[row], mode, seed)
            model.fit(for_training(train, family, chosen[row]))
            models[key] = model, time.perf_counter() - began
        model, seconds = models[key]
        shown = for_prediction(test, family, chosen[row])
        estimate = predicted(model, shown, env.reward, actions)
        rows.append(record(settings, row, seed, truth, estimate, tuning + seconds, chosen[row]))
    return rows


def make(task: str, settings: str, family: str, config: Config, mode: str, seed: int) -> Any:
    """Estimator with the paper's settings, or with a configuration of ours."""
    if settings != "paper":
        return build(task, family, config, mode, seed)
    env = environment(task)
    model = paper.model(family, policy=env.policy, reward=env.reward, random_state=seed)
    if family in PAPER_EPOCHS[mode]:
        model.set_params(estimator__max_epochs=PAPER_EPOCHS[mode][family])
    return model


def chosen_configs(
    task: str,
    settings: str,
    family: str,
    mode: str,
    seed: int,
    train: TrajectoryDataset,
    reward: Any,
) -> tuple[dict[str, Config], float]:
    """Configuration of each row, and the seconds that choosing took.

    Tuned: the candidate with the least squared reward error on a fifth of the training
    episodes, held out.
    """
    rows = variants(family)
    if settings != "tuned":
        return {row: {} for row in rows}, 0.0
    began = time.perf_counter()
    order = np.random.default_rng(seed).permutation(len(train))
    held, kept = train[order[: len(train) // 5]], train[order[len(train) // 5 :]]
    truth = true_rewards(held, reward)
    tried = candidates(task, family)
    scores: dict[str, list[float]] = {row: [] for row in rows}
    for config in tried:
        model = build(task, family, config, mode, seed)
        model.fit(for_training(kept, family, config))
        shown = for_prediction(held, family, config)
        for row, actions in rows.items():
            estimate = predicted(model, shown, reward, actions)
            scores[row].append(float(np.mean((estimate - truth) ** 2)))
    best = {row: tried[int(np.nanargmin(scores[row]))] for row in rows}
    return best, time.perf_counter() - began


def record(
    settings: str,
    row: str,
    seed: int,
    truth: np.ndarray,
    estimate: np.ndarray,
    seconds: float,
    config: Config,
) -> dict[str, Any]:
    """One line of the raw results."""
    errors = reward_errors(estimate, truth)
    return {
        "settings": settings,
        "row": row,
        "seed": seed,
        "mean": float(errors["mean"]),
        "std": float(errors["std"]),
        "median": float(errors["median"]),
        "n_diverged": int(errors["n_diverged"]),
        "signed_std": float(np.std(estimate - truth)) if np.isfinite(estimate).all() else np.inf,
        "seconds": seconds,
        "config": config,
    }


# -- table ----------------------------------------------------------------------------------------


def table(task: str, records: list[dict[str, Any]]) -> pd.DataFrame:
    """One line a method: mean over seeds of the mean squared error, its spread, medians."""
    frame = pd.DataFrame(records)
    lines = []
    for (settings, row), some in frame.groupby(["settings", "row"], sort=False):
        printed = PAPER[task].get(row) if settings == "paper" else None
        lines.append(
            {
                "settings": settings,
                "method": row,
                "predicts from": MAPPING[row],
                "MSE": some["mean"].mean(),
                "MSE std over seeds": some["mean"].std(ddof=1) if len(some) > 1 else np.nan,
                "std of squared error": some["std"].mean(),
                "median squared error": some["median"].median(),
                "diverged": int(some["n_diverged"].sum()),
                "paper": None if printed is None else f"{printed[0]:g} ± {printed[1]:g}",
                "seconds": some["seconds"].mean(),
            }
        )
    return pd.DataFrame(lines)


def markdown(frame: pd.DataFrame) -> str:
    """The table as people read it."""

    def number(value: Any) -> str:
        if value is None or (isinstance(value, float) and np.isnan(value)):
            return ""
        return f"{value:.2g}" if isinstance(value, float) else str(value)

    head = list(frame.columns)
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for _, line in frame.iterrows():
        lines.append("| " + " | ".join(number(line[name]) for name in head) + " |")
    return "\n".join(lines)


def brief(task: str, records: list[dict[str, Any]]) -> str:
    """Compact Markdown table for the README: one line a method, one column a kind of settings."""
    frame = table(task, records).set_index(["settings", "method"])

    def entry(settings: str, method: str) -> str:
        if (settings, method) not in frame.index:
            return ""
        line = frame.loc[(settings, method)]
        return f"{line['MSE']:.2g} ± {line['MSE std over seeds']:.1g}"

    lines = [
        "| method | paper prints | its settings, actions aligned | tuned | library defaults |",
        "|---|---|---|---|---|",
    ]
    for method in MAPPING:
        if method == "constant":
            cells = ["", "", "", entry("-", method)]
        else:
            printed = PAPER[task].get(method)
            cells = ["" if printed is None else f"{printed[0]:g}"]
            cells += [entry(settings, method) for settings in ("paper", "tuned", "default")]
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(
        prog="trajlearn reproduce reward-table",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--task", choices=sorted(PAPER), default="cartpole")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds (default: 3)")
    parser.add_argument("--quick", action="store_true", help="one seed, fewer gradient steps")
    parser.add_argument("--n-jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--out", type=Path, help="folder of the results")
    options = parser.parse_args()
    mode = "quick" if options.quick else "full"
    seeds = list(range(1 if options.quick else options.seeds))
    # a quick run never overwrites the results that the documentation quotes
    out = options.out or (RESULTS if mode == "full" else Path("results") / "reward-table")
    out = out.resolve()
    records = run(options.task, seeds, mode, out, options.n_jobs)
    frame = table(options.task, records)
    payload = provenance(
        mode,
        seeds,
        task=options.task,
        n_episodes=N_EPISODES,
        length=LENGTH[options.task],
        max_steps=MAX_STEPS[mode],
        candidates={family: candidates(options.task, family) for family in CANDIDATES},
    )
    write_json(out / f"{options.task}.json", payload | {"records": records})
    text = markdown(frame)
    (out / f"{options.task}.md").write_text(text + "\n", encoding="utf-8")
    draw(options.task, frame, out / f"{options.task}.png")
    print(f"\n{text}\n\nSquared error of the reward per step on {N_EPISODES} test episodes.")
    print(f"Written to {out} ({options.task}.json, .md, .png).")
    if mode == "quick":
        print("This was the quick mode: one seed, short training. The full table, about ten")
        print("minutes: .venv/bin/trajlearn reproduce reward-table --task cartpole --seeds 3")


def run(task: str, seeds: list[int], mode: str, out: Path, n_jobs: int) -> list[dict[str, Any]]:
    """All records, cell by cell; finished cells are taken from disk."""
    plan = [("paper", family) for family in ("GP", "NN", "D", "T")]
    plan += [("tuned", family) for family in ("GP", "NN", "D", "C", "T")]
    plan += [("default", family) for family in ("D", "C", "T")]
    plan += [("-", "constant")]
    cells = [
        {"task": task, "settings": settings, "family": family, "mode": mode, "seed": seed}
        for seed in seeds
        for settings, family in plan
    ]
    nested = run_cells(
        cells, cell, out / "cells" / mode, n_jobs=n_jobs, description=f"reward-table {task}"
    )
    records = [record for records in nested for record in records]
    order = {key: i for i, key in enumerate(["paper", "tuned", "default", "-"])}
    return sorted(records, key=lambda record: order[record["settings"]])


def draw(task: str, frame: pd.DataFrame, path: Path) -> None:
    """Bar plot of the table."""
    from trajlearn.plotting import plot_reward_table

    printed = [
        PAPER[task].get(row, (np.nan,))[0] if settings == "paper" else np.nan
        for settings, row in zip(frame["settings"], frame["method"], strict=True)
    ]
    labels = [
        row if settings == "-" else f"{row} ({settings})"
        for settings, row in zip(frame["settings"], frame["method"], strict=True)
    ]
    bars = pd.DataFrame(
        {
            "mean": frame["MSE"].to_numpy(),
            "median": frame["median squared error"].to_numpy(),
            "paper": printed,
            "n_diverged": frame["diverged"].to_numpy(),
        },
        index=labels,
    )
    axes = plot_reward_table(bars)
    axes.figure.savefig(path, dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
