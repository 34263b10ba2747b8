"""Simulated episodes for the study of uncertainty, and its cells: fit, forecast, calibrate."""

import time
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper._rollouts import expected_warnings
from benchmarks.paper._tasks import N_EPISODES, environment
from benchmarks.paper._uncertainty_models import (
    CALIBRATION,
    GP_ROWS,
    GP_SPARSE,
    SMALL,
    TEST,
    VARIANTS,
    Variant,
    estimator_of,
)
from benchmarks.paper._uncertainty_scores import (
    LEVEL,
    brief,
    calibrated,
    forecast_of,
    growth,
    sampled,
    scores,
    whole,
)
from trajlearn import Forecast, TrajectoryDataset

#: Steps of all episodes: training, calibration and test.
LENGTH = {"full": 200, "quick": 100}
#: Sizes of small sets of calibration episodes, and how many sets of each.
SMALL_SETS = {20: 5, 50: 4, 100: 2}
#: Test episodes of which trajectories are sampled, and how many of each.
N_SAMPLED = 50
#: States of the example: of the joint whose motion is largest.
SHOWN_STATES = ("cos_base_z", "velocity_base_z", "velocity_elbow_z")
_EXAMPLES = 20
# seeds of calibration episodes, test episodes and noise; those of training are as everywhere
_OTHERS, _NOISE = 10_000, 20_000


class Data(NamedTuple):
    """Episodes as measured, and the test episodes without measurement noise."""

    train: TrajectoryDataset
    calibration: TrajectoryDataset
    test: TrajectoryDataset
    true: TrajectoryDataset


def simulator(task: str, process: float | None) -> Any:
    """The system, with another process noise than its own where one is given."""
    env = environment(task)
    return env if process is None else replace(env, noise=process)


def data(task: str, noise: float, process: float | None, mode: str, seed: int) -> Data:
    """Episodes of seeds that never meet; all with noise of the same size.

    Parameters
    ----------
    task : str
    noise : float
        Of the measurements, in standard deviations of each state over all episodes.
    process : float or None
        None: that of the system.
    mode : str
    seed : int
    """
    env, length = simulator(task, process), LENGTH[mode]
    n, m = N_EPISODES, CALIBRATION[mode]
    parts = [
        env.collect(n, length, random_state=2 * seed),
        env.collect(m, length, random_state=_OTHERS + 2 * seed),
        env.collect(TEST[mode], length, random_state=_OTHERS + 2 * seed + 1),
    ]
    clean = parts[0].concatenate(*parts[1:])
    noisy = clean.add_noise(noise, random_state=_NOISE + seed) if noise else clean
    return Data(noisy[:n], noisy[n : n + m], noisy[n + m :], clean[n + m :])


# -- cells --------------------------------------------------------------------------------


def cell(
    task: str, noise: float, process: float | None, fit: str, mode: str, seed: int
) -> dict[str, Any]:
    """Fit one model, and score the forecasts of its variants, raw and calibrated.

    Returns
    -------
    dict
        ``fit_seconds``; ``variants``: of each its ``scores`` (lines), ``growth`` (lines),
        ``whole`` (lines), ``samples`` (lines, of some models) and ``seconds`` (CPU, of a
        thousand forecasts).
    """
    episodes = data(task, noise, process, mode, seed)
    policy = simulator(task, process).policy
    estimator = estimator_of(fit, policy, mode=mode, seed=seed)
    began = time.process_time()
    estimator.fit(episodes.train)
    result: dict[str, Any] = {"fit_seconds": time.process_time() - began, "variants": {}}
    for variant in VARIANTS[fit]:
        if variant.task in (None, task):
            estimator.set_params(**variant.parameters)
            result["variants"][variant.name] = _assessed(
                estimator, variant, episodes, noisy=noise > 0, mode=mode, seed=seed
            )
    return result


def _assessed(
    model: Any, variant: Variant, episodes: Data, *, noisy: bool, mode: str, seed: int
) -> dict[str, Any]:
    n, m = variant.sizes(mode)
    some = {"calibration": episodes.calibration[:n], "test": episodes.test[:m]}
    began = time.process_time()
    with expected_warnings():
        raw = {
            name: forecast_of(model, ds, seed=seed, actions=variant.actions)
            for name, ds in some.items()
        }
        seconds = (time.process_time() - began) / (n + m) * 1000
        by_kind = {"raw": raw["test"]} | {
            kind: calibrated(raw, some["calibration"], some["test"], random_state=seed, **settings)
            for kind, settings in KINDS.items()
        }
    lines, bands = [], []
    for kind, forecast in by_kind.items():
        bands.append({"kind": kind} | whole(forecast, some["test"]))
        key = {"kind": kind, "n_calibration": n}
        found = []
        if kind in ("raw", "conformal"):
            found = scores(forecast, some["test"])
        elif kind == "variance":
            found = brief(forecast, some["test"])
        lines += [key | {"truth": "observed"} | line for line in found]
        if kind == "conformal" and noisy:
            true = brief(forecast, episodes.true[:m])
            lines += [key | {"truth": "true"} | line for line in true]
    drawn: list[dict[str, Any]] = []
    if variant.name in SMALL:
        lines += _small(raw, some["calibration"], some["test"])
        few = some["test"][:N_SAMPLED]
        with expected_warnings():
            joint = model.predict(few, return_std=True, n_samples=N_SAMPLED, random_state=seed)
        drawn = sampled(joint, few)
    return {
        "scores": lines,
        "growth": growth(raw["test"], some["test"]),
        "whole": bands,
        "samples": drawn,
        "seconds": seconds,
    }


#: Ways to calibrate.
KINDS: dict[str, dict[str, Any]] = {
    "conformal": {"method": "conformal"},
    "variance": {"method": "variance"},
    "simultaneous": {"method": "conformal", "band": "simultaneous"},
}


def _small(
    raw: dict[str, Forecast], calibration: TrajectoryDataset, test: TrajectoryDataset
) -> list[dict[str, Any]]:
    """Scores behind sets of few calibration episodes, which share none; and behind all of them."""
    lines = []
    for size, n_sets in (SMALL_SETS | {len(calibration): 1}).items():
        for k in range(min(n_sets, len(calibration) // size)):
            part = np.arange(k * size, (k + 1) * size)
            few = raw | {"calibration": raw["calibration"][part]}
            forecast = calibrated(few, calibration[part], test)
            key = {"kind": "set", "n_calibration": size, "truth": "observed", "set": k}
            lines += [key | line for line in brief(forecast, test)]
    return lines


def example_cell(task: str, fits: list[str], mode: str, seed: int) -> dict[str, Any]:
    """One test episode with the forecasts of some models, without noise.

    Of the first test episodes the one on which T has its median error (the lower).

    Returns
    -------
    dict
        ``episode``, ``dt`` [s], ``states`` (names), ``truth`` (T, k), ``forecasts``: of each
        variant ``mean`` and ``std`` (T, k), in the units of the states.
    """
    episodes = data(task, 0.0, None, mode, seed)
    env, few = environment(task), episodes.test[:_EXAMPLES]
    forecasts: dict[str, Forecast] = {}
    for fit in fits:
        model = estimator_of(fit, env.policy, mode=mode, seed=seed).fit(episodes.train)
        for variant in VARIANTS[fit]:
            model.set_params(**variant.parameters)
            with expected_warnings():
                forecasts[variant.name] = forecast_of(
                    model, few, seed=seed, actions=variant.actions
                )
    error = forecasts["T"].squared_errors(few).mean(axis=(1, 2))
    i = int(np.argsort(error, kind="stable")[(len(error) - 1) // 2])
    columns = [few.state_names.index(name) for name in shown_states(few.state_names)]

    def shown(values: NDArray[np.float64] | None) -> NDArray[np.float64]:
        assert values is not None  # asked for
        return values[i][:, columns]

    return {
        "episode": i,
        "dt": env.dt,
        "states": shown_states(few.state_names),
        "truth": few[i].states[1:, columns],
        "forecasts": {
            name: {"mean": shown(f.mean), "std": shown(f.std)} for name, f in forecasts.items()
        },
    }


def shown_states(names: tuple[str, ...]) -> list[str]:
    """States of the example: those chosen for the reacher, else the first."""
    return [name for name in SHOWN_STATES if name in names] or list(names[:3])


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know of the simulated part."""
    return {
        "n_train": N_EPISODES,
        "n_calibration": CALIBRATION[mode],
        "n_test": TEST[mode],
        "length": LENGTH[mode],
        "noise": "measurement noise in standard deviations of each state, on all episodes",
        "level": LEVEL,
        "variants": {
            fit: [_facts(variant, mode) for variant in some] for fit, some in VARIANTS.items()
        },
        "gaussian_processes": {"rows_of_the_exact_one": GP_ROWS, "sparse": GP_SPARSE},
        "small_sets": SMALL_SETS,
    }


def _facts(variant: Variant, mode: str) -> dict[str, Any]:
    n_calibration, n_test = variant.sizes(mode)
    facts = {"name": variant.name, "n_calibration": n_calibration, "n_test": n_test}
    return facts | {"n_particles": variant.particles(mode), "only_on": variant.task}
