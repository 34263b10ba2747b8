"""Real flights in the study of uncertainty: train, calibrate and test on other experiments."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.paper._command import Run
from benchmarks.paper._flights_data import N_FOLDS, flights, folds
from benchmarks.paper._flights_models import build
from benchmarks.paper._rollouts import expected_warnings
from benchmarks.paper._uncertainty_scores import (
    LEVEL,
    bins_of,
    bounds,
    by_episode,
    calibrated,
    growth,
    scores,
)
from trajlearn import TrajectoryDataset
from trajlearn.evaluation import interval_hits

#: Steps of a forecast, steps from one start to the next, and steps before the first.
HORIZON, STRIDE, BEFORE = 200, 50, 1
MODELS = {"full": ["P", "PE", "TPE", "T"], "quick": ["P", "T"]}
SPLIT = "experiment"
#: Particles behind the standard deviations of P and PE.
PARTICLES = 20


def estimator_of(model: str, mode: str, seed: int) -> Any:
    """Estimator by name; P and PE see the previous action and replay what was logged."""
    if model in ("P", "PE"):
        estimator = build("D, logged actions, previous", mode, seed)
        return estimator.set_params(
            n_particles=PARTICLES,
            estimator__probabilistic=True,
            estimator__n_members=1 if model == "P" else 5,
        )
    estimator = build("T, tracking error", mode, seed)
    if model == "TPE":
        return estimator.set_params(estimator__probabilistic=True, estimator__n_members=5)
    return estimator.set_params(estimator__probabilistic="separate")


def pieces(ds: TrajectoryDataset) -> TrajectoryDataset:
    """Windows of the flights from every start, as episodes of their own.

    Each is as long as a forecast and one step before it, so that there is a previous action.
    """
    return ds.window(BEFORE + HORIZON, stride=STRIDE)


def parts(fold: int) -> tuple[TrajectoryDataset, TrajectoryDataset, TrajectoryDataset]:
    """Flights for training, and pieces of those for calibration and for test."""
    ds = flights().ds
    tests = [test for _, test in folds(ds, SPLIT)]
    held, test = tests[(fold + 1) % N_FOLDS], tests[fold]
    train = np.setdiff1d(np.arange(len(ds)), np.concatenate([held, test]))
    return ds[train], pieces(ds[held]), pieces(ds[test])


def cell(model: str, fold: int, mode: str, seed: int) -> dict[str, Any]:
    """Scores on the test pieces of a fold, raw and calibrated on the flights of the next fold.

    Returns
    -------
    dict
        ``scores`` (lines), ``growth`` (lines), ``group`` (experiment of each piece) and
        ``inside``: of "raw" and "conformal" the share of states and steps inside the interval,
        of each piece and bin.
    """
    train, calibration, test = parts(fold)
    estimator = estimator_of(model, mode, seed).fit(train)
    with expected_warnings():
        raw = {
            name: estimator.predict(ds, start=BEFORE, return_std=True, random_state=seed)
            for name, ds in (("calibration", calibration), ("test", test))
        }
        forecasts = {"raw": raw["test"], "conformal": calibrated(raw, calibration, test)}
    lines: list[dict[str, Any]] = []
    inside = {}
    for kind, forecast in forecasts.items():
        lines += [{"kind": kind} | line for line in scores(forecast, test)]
        inside[kind] = by_episode(interval_hits(forecast, test, LEVEL))
    return {
        "scores": lines,
        "growth": growth(raw["test"], test),
        "group": np.asarray(test.group).astype(str),
        "inside": inside,
    }


# -- all folds ----------------------------------------------------------------------------


def run_flights(run: Run) -> tuple[pd.DataFrame, pd.DataFrame] | None:
    """Scores and growth over all folds; None without the flights."""
    try:
        flights()
    except OSError as error:
        print(f"The real flights are left out, they cannot be had: {error}")
        return None
    cells = cells_of(run)
    results = list(zip(cells, run.cells(cells, cell), strict=True))
    return _scores(results), _growth(results)


def cells_of(run: Run) -> list[dict[str, Any]]:
    """All cells of a run."""
    return [
        {"model": model, "fold": fold, "mode": run.mode, "seed": seed}
        for model in MODELS[run.mode]
        for fold in range(N_FOLDS if run.mode == "full" else 1)
        for seed in run.seeds
    ]


def _scores(results: list[tuple[dict[str, Any], dict[str, Any]]]) -> pd.DataFrame:
    """Means over folds by the number of pieces; the interval draws experiments anew.

    Columns ``n_groups`` (experiments tested in all folds) and ``groups_of_fold`` (mean over the
    folds, each of which calibrates another one).
    """
    lines = [
        pd.DataFrame(result["scores"]).assign(
            model=asked["model"], seed=asked["seed"], fold=asked["fold"]
        )
        for asked, result in results
    ]
    keys = ["model", "kind", "seed", "first", "last"]
    table = pd.concat(lines, ignore_index=True).drop(columns=["low", "high"])
    measures = [c for c in table if c not in (*keys, "fold", "n_episodes", "n_diverged")]
    by = table.groupby(keys, sort=False)
    pooled = by[["n_episodes", "n_diverged"]].sum()
    for measure in measures:
        weighted = table[measure] * table["n_episodes"]
        total = weighted.groupby([table[key] for key in keys], sort=False)
        # what has no value in one fold has none at all
        pooled[measure] = total.agg(lambda some: some.sum(skipna=False)) / pooled["n_episodes"]
    groups = {asked["fold"]: set(result["group"]) for asked, result in results}
    n_groups = len(set().union(*groups.values()))
    of_fold = np.mean([len(some) for some in groups.values()])
    pooled = pooled.reset_index().assign(n_groups=n_groups, groups_of_fold=of_fold)
    found = {key: bounds(*some) for key, some in _inside(results).items()}
    index = {bin_: i for i, bin_ in enumerate(bins_of(HORIZON))}
    own = [
        [bound[index[line.first, line.last]] for bound in found[line.model, line.kind]]
        for line in pooled.itertuples()
    ]
    return pooled.assign(**dict(zip(("low", "high"), np.transpose(own), strict=True)))


def _inside(results: list[Any]) -> dict[tuple[str, str], tuple[Any, Any]]:
    """Shares of each piece and bin, mean over seeds, and its experiment; by model and kind."""
    shares: dict[Any, dict[int, list[Any]]] = {}
    groups: dict[int, list[str]] = {}
    for asked, result in results:
        groups[asked["fold"]] = list(result["group"])
        for kind, some in result["inside"].items():
            by_fold = shares.setdefault((asked["model"], kind), {})
            by_fold.setdefault(asked["fold"], []).append(np.array(some, dtype=float))
    return {
        key: (
            np.concatenate([np.mean(by_seed, axis=0) for by_seed in by_fold.values()]),
            np.concatenate([groups[fold] for fold in by_fold]),
        )
        for key, by_fold in shares.items()
    }


def _growth(results: list[Any]) -> pd.DataFrame:
    lines = [
        pd.DataFrame(result["growth"]).assign(model=asked["model"], seed=asked["seed"])
        for asked, result in results
    ]
    by = pd.concat(lines, ignore_index=True).groupby(["model", "seed", "horizon"], sort=False)
    return by[["std", "error"]].median().reset_index()


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know of the real flights."""
    return {
        "split": SPLIT,
        "folds": N_FOLDS if mode == "full" else 1,
        "horizon": HORIZON,
        "stride": STRIDE,
        "level": LEVEL,
        "n_particles": PARTICLES,
        "models": {
            model: " ".join(str(estimator_of(model, mode, 0)).split()) for model in MODELS[mode]
        },
    }
