"""Models of networks' weights as people read them: text from the tables alone."""

from typing import Any

import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._intervals import spread
from benchmarks.paper._network_models import (
    EVERY,
    INPUT_SCALE,
    N_PROBES,
    N_STARTS,
    POLICY,
    WIDTHS,
    WINDOWS,
    shown,
)


def report(tables: Tables) -> str:
    """What models know of networks they have not seen, and what a search on them finds."""
    scores, errors = tables["scores"], tables["errors"]
    lines = ["### Held-out networks, and what CMA-ES finds", "", markdown(_summary(scores)), ""]
    lines += [*_explained(scores), "", "### Error by horizon", "", markdown(_windows(errors)), ""]
    lines += [
        "Median squared error of held-out episodes that reach the window, up to their end (range "
        "of the training states = 1); median over seeds (least to greatest). At the longest "
        "horizons only networks that stand are left.",
        "",
        *_verdict(scores),
    ]
    return "\n".join(lines)


def _spread(values: pd.Series, how: str = ".2f") -> str:
    some = values.dropna()
    return spread(some, how) if len(some) else ""


def _summary(scores: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for (n, model), some in scores.groupby(["n", "model"], sort=False):
        lines.append(
            {
                "episodes": n,
                "model": "constant; best logged network"
                if model == "constant"
                else shown(str(model)),
                "squared error": _spread(some["mse"], ".2g"),
                "rank correlation": _spread(some["rank"]),
                "found: true": _spread(some["found"]),
                "found: predicted": _spread(some["promised"]),
                "s to fit": _seconds(some["fit_s"]) if model != "simulator" else "",
                "s to search": _seconds(some["search_s"]),
            }
        )
    return pd.DataFrame(lines)


def _seconds(values: pd.Series) -> str:
    return "" if values.isna().all() else f"{values.median():.2g}"


def _explained(scores: pd.DataFrame) -> list[str]:
    told, plain = (
        " and ".join(f"{100 * share:.1f} % of {n}" for n, share in column.items())
        for column in (scores.groupby("n")[name].median() for name in ("stood", "stood_unscaled"))
    )
    return [
        "Median over seeds (least to greatest), returns per step. Squared error and rank "
        f"correlation: of held-out networks, mean return over {N_STARTS['assess']} starts. Found: "
        "what the search takes to be best, as predicted and in the simulator over "
        f"{N_STARTS['proposal']} starts. All searches begin with the same best logged networks "
        f"and have the same number of evaluations, over {N_STARTS['search']} starts. T gives the "
        f"reward of every {EVERY}th step. The best logged network is the one of the greatest "
        "logged return, from its one start (shown as predicted).",
        "",
        f"Weights are drawn from U[-1, 1] times a scale: {WIDTHS['input']:g} over "
        f"{', '.join(format(s, 'g') for s in INPUT_SCALE)} (position, speed, angle, rate) into "
        f"the hidden layer, {WIDTHS['output']:g} out of it, {WIDTHS['bias']:g} for biases. With "
        f"these {told} logged episodes stand for the whole trial; with U[-1, 1] as it is, {plain}.",
    ]


def _windows(errors: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for (n, model), some in errors.groupby(["n", "model"], sort=False):
        line: dict[str, Any] = {"episodes": n, "model": model}
        for window in WINDOWS:
            at = some[some["window"] == window]
            line[f"steps {window}"] = _spread(at["median"], ".1g")
        lines.append(line)
    return pd.DataFrame(lines)


def _verdict(scores: pd.DataFrame) -> list[str]:
    """Who ranks best and who finds most, in the median over seeds."""
    text = []
    real = scores[~scores["model"].isin(["constant", "simulator"])]
    for n, some in real.groupby("n"):
        rank = some.groupby("model")["rank"].median()
        found = some.groupby("model")["found"].median()
        logged = scores[(scores["n"] == n) & (scores["model"] == "constant")]["found"].median()
        better = ", ".join(found[found > logged].sort_values(ascending=False).index) or "none"
        without = rank.drop("D, policy", errors="ignore")
        over = (some["promised"] - some["found"]).groupby(some["model"]).median()
        text.append(
            f"- {n} episodes: {rank.idxmax()} ranks best ({rank.max():.2f}), of those that do not "
            f"roll the network out {without.idxmax()} ({without.max():.2f}). Better networks than "
            f"the best logged one ({logged:.2f}) are found on: {better}. What is found is furthest "
            f"below its prediction on {over.idxmax()} (by {over.max():.2f})."
        )
    return [
        *text,
        "",
        f"Any permutation of the hidden units gives the same controller, by other values of the "
        f"{POLICY.n_params} weights. Responses are {N_PROBES} numbers that it leaves as they are; "
        "they need the network as code, as a roll-out does. D learns the plant alone, from states "
        "without noise, and is given the network.",
    ]
