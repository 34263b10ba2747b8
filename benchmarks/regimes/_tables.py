"""Tables of the cells, and how far the selector is from the best single model."""

from typing import Any

import numpy as np
import pandas as pd

from benchmarks.regimes._members import RULES
from benchmarks.regimes._regimes import REGIMES
from benchmarks.regimes._scores import BLOCK_ENDS, block_of

#: Errors below this count as equal: a hundred thousandth of the range.
EXACT = 1e-10
#: Regimes and models whose errors by horizon are kept for a figure.
CURVES = {
    "cartpole": (
        "clean",
        "noise 3 %",
        "noise 10 %",
        "process .05",
        "positions only",
        "20 episodes, noise 3 %",
    ),
    "reacher": ("clean", "noise 1 %"),
    "quadrotor": ("clean", "noise 3 %"),
    "flights": ("real flights",),
}
CURVE_MODELS = (
    *("T", "C", "network", "network_em", "poly3", "poly3_em", "poly1_latent"),
    *("gp", "PySINDy", "sklearn-GP", "pick"),
)
BLOCKS = [f"block_{i}" for i in range(1, len(BLOCK_ENDS) + 1)]

# (asked, found) of cells
Found = list[tuple[dict[str, Any], dict[str, Any]]]
Key = tuple[str, str, int]


def models_of(ours: Found, peers: Found) -> dict[Key, dict[str, dict[str, Any]]]:
    """Scores of every model, by regime, policy and seed."""
    found: dict[Key, dict[str, dict[str, Any]]] = {}
    for asked, result in ours:
        for policy, some in result["policies"].items():
            found[asked["regime"], policy, asked["seed"]] = dict(some["models"])
    for asked, result in peers:
        key = (asked["regime"], asked["policy"], asked["seed"])
        if "scores" in result:
            found.setdefault(key, {})[asked["peer"]] = result["scores"]
    return found


def tables(system: str, ours: Found, peers: Found, floors: Found) -> dict[str, pd.DataFrame]:
    """All tables of one system, by stem.

    Returns
    -------
    dict of DataFrame
        ``scores``: a line a model, regime, policy and seed: ``cum``, ``reward``, ``n_diverged``,
        and the median error over episodes, averaged over all horizons (``typical``) and over
        those of a block; ``ratios``: see `ratios`; ``curves``: errors by
        horizon of some; ``choice``: what the pick consists of; ``fits``: seconds and noise by
        member; ``peers``: settings, seconds and failures; ``floors``: errors of the plant itself.
    """
    by_key = models_of(ours, peers)
    scores, curves, apart = [], [], []
    for (regime, policy, seed), models in by_key.items():
        key = {"regime": regime, "policy": policy, "seed": seed}
        for model, some in models.items():
            line = {name: some[name] for name in ("cum", "reward", "n_diverged")}
            line["typical"] = typical(some)
            blocks = dict(zip(BLOCKS, some["blocks"], strict=True))
            scores.append(key | {"model": model} | line | blocks)
            if regime in CURVES[system] and model in CURVE_MODELS:
                curve = {name: some["curve"][name] for name in ("horizon", "median", "mean")}
                curves.append(pd.DataFrame(key | {"model": model} | curve))
        apart += [key | line for line in ratios(models)]
    found = {
        "scores": pd.DataFrame(scores),
        "ratios": pd.DataFrame(apart),
        "curves": pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(),
        "choice": _choices(ours),
        "fits": _fits(ours),
        "peers": _peers(peers),
        "floors": pd.DataFrame(
            [
                {name: asked[name] for name in ("regime", "seed")}
                | {name: found["scores"][name] for name in ("cum", "reward")}
                | {"typical": typical(found["scores"])}
                for asked, found in floors
            ]
        ),
    }
    return {f"{system}-{stem}": table for stem, table in found.items() if len(table)}


def typical(scores: dict[str, Any]) -> float:
    """Median error over episodes, averaged over all horizons."""
    length = scores["curve"]["horizon"][-1]
    horizons = [block_of(h, length) for h in range(1, length + 1)]
    return float(np.average(scores["blocks"], weights=np.bincount(horizons)))


def ratios(models: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Error of each rule over that of the best single model, at every stored horizon.

    The best single of a horizon is found on one half of the test episodes, and both are judged
    on the other half; then the other way round, and the geometric mean is taken.

    Returns
    -------
    list of dict
        ``rule``, ``statistic`` over episodes, and over horizons the ``least``, ``q25``,
        ``middle``, ``q75`` and ``worst`` ratio.
    """
    singles = [name for name in models if name not in RULES]
    lines = []
    for statistic in ("median", "mean"):
        halves = [
            {
                name: np.maximum(some["curve"][f"{statistic}_{half}"], EXACT)
                for name, some in models.items()
            }
            for half in (0, 1)
        ]
        for rule in RULES:
            if rule not in models:
                continue
            logs = []
            for chosen_on, judged_on in (halves, halves[::-1]):
                errors = np.stack([chosen_on[name] for name in singles])
                best = errors.argmin(axis=0)
                against = np.stack([judged_on[name] for name in singles])
                against = against[best, np.arange(len(best))]
                logs.append(_log_ratio(judged_on[rule], against))
            over = np.exp(np.mean(logs, axis=0))
            # without interpolation, which infinity spoils
            levels = [0.0, 0.25, 0.5, 0.75, 1.0]
            low, q25, middle, q75, high = np.quantile(over, levels, method="inverted_cdf")
            spread = {"least": low, "q25": q25, "middle": middle, "q75": q75, "worst": high}
            lines.append({"rule": rule, "statistic": statistic} | spread)
    return lines


def _log_ratio(one: Any, other: Any) -> Any:
    """Logarithm of a ratio of errors; two infinite ones are equal."""
    with np.errstate(invalid="ignore"):
        found = np.log(one) - np.log(other)
    return np.where(np.isinf(one) & np.isinf(other), 0.0, found)


def _choices(ours: Found) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "regime": asked["regime"],
                "policy": policy,
                "seed": asked["seed"],
                "best": some["best"],
                "from horizon": ", ".join(f"{h}: {name}" for h, name in some["choice"]),
            }
            for asked, result in ours
            for policy, some in result["policies"].items()
        ]
    )


def _fits(ours: Found) -> pd.DataFrame:
    """Seconds of all fits of each member, and the noise it found over the true noise."""
    lines = []
    for asked, result in ours:
        for member, seconds in result["fit_seconds"].items():
            line = {"regime": asked["regime"], "seed": asked["seed"], "member": member}
            line["seconds"] = seconds
            noise = result["noise"].get(member)
            if noise is not None:
                std, true = np.array(noise["std"]), np.array(noise["true"])
                line |= {"found": noise["found"], "std": float(np.sqrt((std**2).mean()))}
                # 0 where states are exact, NaN where nobody knows
                line["true"] = float(np.sqrt((true**2).mean()))
                line["std/true"] = float(np.median(std / true)) if (true > 0).all() else np.nan
            lines.append(line)
    return pd.DataFrame(lines)


def _peers(peers: Found) -> pd.DataFrame:
    lines = []
    for asked, result in peers:
        line = {name: asked[name] for name in ("regime", "policy", "seed", "peer")}
        if "failure" in result:
            lines.append(line | {"failure": result["failure"][:80]})
            continue
        settings = {k: v for k, v in result["settings"].items() if k != "seed"}
        line["settings"] = ", ".join(f"{k} {v}" for k, v in settings.items())
        lines.append(line | result["seconds"])
    return pd.DataFrame(lines)


def in_order(system: str, names: Any) -> list[str]:
    """Regimes of a system, in their order, of those that are there."""
    there = set(names)
    return [name for some, name in REGIMES if some == system and name in there]
