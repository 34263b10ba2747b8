"""Do the weights of a network do as control parameters? The paper's future work, on the cartpole.

theta is 31 weights (one hidden layer of 5), drawn at random for each logged episode; most fall
within a second and are kept. T sees the weights, or what the network answers at 8 probe states
instead; a one-step model D rolls out the network itself; a Gaussian process goes from the start
and theta straight to the reward. Each ranks held-out networks, and CMA-ES searches all weights
on it. The reward is exp(-(x^2 + theta^2)) a step, nothing after a fall.
"""

from typing import Any

import pandas as pd

from benchmarks.paper import _network_models as models
from benchmarks.paper._command import Benchmark, Run, Tables
from benchmarks.paper._network_figures import draw
from benchmarks.paper._network_page import report


def run(run: Run) -> Tables:
    """Scores of all models, their errors by horizon, and single returns of the first seed."""
    cells = [
        {"model": model, "n": n, "mode": run.mode, "seed": seed}
        for seed in run.seeds
        for n in models.N_LOGGED[run.mode]
        for model in models.MODELS
    ]
    scores, errors, returns = [], [], []
    for asked, result in zip(cells, run.cells(cells, models.cell), strict=True):
        key = {name: asked[name] for name in ("model", "n", "seed")}
        search, seconds = result["search"], result.get("seconds", {})
        scores.append(
            key
            | {name: result.get(name) for name in ("mse", "rank")}
            | {"found": search["true"], "promised": search["predicted"]}
            | {name: search.get(name) for name in ("stood", "stood_unscaled")}
            | {"fit_s": seconds.get("fit"), "search_s": seconds.get("search")}
        )
        if "errors" in result:
            errors.append(pd.DataFrame(key | result["errors"]))
        if "returns" in result and asked["seed"] == run.seeds[0]:
            returns.append(pd.DataFrame(key | result["returns"]))
    return {
        "scores": pd.DataFrame(scores),
        "errors": pd.concat(errors, ignore_index=True),
        "returns": pd.concat(returns, ignore_index=True),
    }


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "hidden": models.POLICY.hidden,
        "input_scale": models.INPUT_SCALE,
        "half_widths_of_the_draw": models.WIDTHS,
        "n_probes": models.N_PROBES,
        "n_logged": models.N_LOGGED[mode],
        "n_held_out": models.N_HELD_OUT[mode],
        "n_evaluations": models.N_EVALUATIONS[mode],
        "n_starts": models.N_STARTS,
        "length": models.LENGTH,
    }


BENCHMARK = Benchmark("network-policy", __doc__, run, report, draw, settings, minutes=10)

if __name__ == "__main__":
    BENCHMARK.main()
