"""Text of the offline search, from its tables alone."""

import numpy as np
import pandas as pd

from benchmarks.paper._command import Tables, markdown
from benchmarks.paper._flights_tables import MAIN
from benchmarks.paper._intervals import rounded
from benchmarks.paper._offline_search_data import EARLY, FIFTH, LATE, RANDOM, SPLITS
from benchmarks.paper._offline_search_ranking import FLOWN, OWN, TASTES, USUAL
from benchmarks.paper._offline_search_rows import CHANCE, FAR, NO_GAINS, T
from benchmarks.paper._offline_search_trials import N_INITIAL, TUNER

CHANCE_ROW = "at random"
_TITLES = {
    RANDOM: "Half of the experiments, at random",
    LATE: "The late half, by models of the early one",
    EARLY: "The early half, by models of the late one",
    FIFTH: "Blocks of a fifth, by models of the others",
}
#: Gains that are listed of a group.
_N_GAINS = 6
# far below what the tables hold, five digits
_NOTHING = 1e-9


def report(tables: Tables) -> str:
    """The pool, ranks and regret by split, taste in gains, and trials."""
    choices = tables["choices"]
    lines = [
        "A model chooses among experiments that it has not seen, before they are flown: it is told "
        "the gains, the set-point and a usual start (the median of the training flights of that "
        "kind). "
        "Tracking error: root mean square along the driven axes, over the part of the motion that "
        "all flights of a kind log, mean over the flights of an experiment. Regret: the flown "
        "error of the experiment with the least predicted one, minus the best flown of those held "
        "out; in brackets, in per cent of their median. Top 3: the mean of the first three "
        "choices, minus the same best. Means over splits and seeds, with the least and the "
        "greatest. Experiments with equal predictions are as good as drawn at random.",
        "",
        "### What was flown",
        "",
        *_pool(tables["pool"]),
        "",
    ]
    for split in SPLITS:
        some = choices[choices["split"] == split]
        if len(some):
            lines += [f"### {_TITLES[split]}", "", markdown(_summary(some)), ""]
            lines += [*_best(some), ""]
    lines += ["### What a start gives away", "", *_starts(choices), ""]
    lines += ["### Which gains", "", *_gains(tables["gains"]), ""]
    lines += ["### Ask and tell over what was flown", "", *_trials(tables), ""]
    return "\n".join(lines)


def _pool(table: pd.DataFrame) -> list[str]:
    shown = pd.DataFrame(
        {
            "group": table["group"],
            "experiments": table["n"].map(str),
            "flights": table["n_flights"].map(str),
            "best mm": table["best"].map(lambda v: rounded(v, 3)),
            "median mm": table["median"].map(lambda v: rounded(v, 3)),
            "worst mm": table["worst"].map(lambda v: rounded(v, 3)),
            "repeats differ by mm": [
                f"{rounded(std)} ({n} repeats)" if n else "not repeated"
                for std, n in zip(table["repeat_std"], table["n_repeats"], strict=True)
            ],
            "rank correlation of a flight with its repeats": table["repeat_rho"],
        }
    )
    return [
        "A standard deviation between flights with the same gains is what no model of the gains "
        "can know: a regret below it may be chance. The rank correlation of flights with the mean "
        "of their repeats says how much of an error comes back. It is no upper limit: repeats "
        "scatter themselves, and a model that knew the expected error would do somewhat better.",
        "",
        markdown(shown),
    ]


def _short(group: str) -> str:
    return group.removesuffix(" motors").replace("upgraded", "upgr.").replace("standard", "std.")


def _over(values: pd.Series, digits: int = 2) -> str:
    """Mean, and least and greatest where they differ; nothing for what is undefined."""
    there = values.dropna()
    if not len(there):
        return "none"
    # a mean of numbers that cancel is 0, not what rounding leaves of it
    exact = [0.0 if abs(v) < _NOTHING else v for v in (there.min(), there.mean(), there.max())]
    low, mean, high = (rounded(v, digits) for v in exact)
    return mean if low == high else f"{mean} ({low} to {high})"


def _regret(some: pd.DataFrame, column: str = "chosen") -> str:
    regret = some[column] - some["best"]
    share = 100 * (regret / some["median"]).mean()
    return f"{_over(regret)} [{rounded(share)} %]"


def _names(choices: pd.DataFrame) -> list[tuple[str, str]]:
    return list(choices[["row", "start"]].drop_duplicates().itertuples(index=False, name=None))


def _summary(choices: pd.DataFrame) -> pd.DataFrame:
    """A line a row: the main group in full, of the others rank correlation and regret."""
    groups = [MAIN, *sorted(set(choices["group"]) - {MAIN})]
    lines = []
    usual = choices[choices["start"] == USUAL]
    for row, own in usual.groupby("row", sort=False):
        line = {"row": row}
        for group in groups:
            mine, name = own[own["group"] == group], _short(group)
            line[f"{name}: rank corr."] = _over(mine["rho"])
            line[f"{name}: regret mm"] = _regret(mine)
            if group == MAIN:
                line[f"{name}: top 3 mm"] = _regret(mine, "top")
        lines.append(line)
    one = usual[usual["row"] == usual["row"].iloc[0]]
    chance, least = {"row": CHANCE_ROW}, {"row": "least possible"}
    for group in groups:
        mine, name = one[one["group"] == group], _short(group)
        chance[f"{name}: regret mm"] = _regret(mine, "random")
        least[f"{name}: regret mm"] = "0"
        for line, column in ((chance, "random"), (least, "best_top")):
            line[f"{name}: rank corr."] = ""
            if group == MAIN:
                line[f"{name}: top 3 mm"] = _regret(mine, column)
    return pd.DataFrame([*lines, chance, least])


def _fewest(hits: pd.DataFrame) -> str:
    """The rows with the fewest trials in a group, T, and chance."""
    middle = hits[hits["row"] != TUNER].groupby("row", sort=False)["within"].apply(_middle)
    least = [str(row) for row, value in middle.items() if value == middle.min()]
    others = [f"; {middle[row]} ({row})" for row in (T, FAR, CHANCE) if row not in least]
    return (
        f"{hits['group'].iloc[0]}, fewest trials until within 5 %: {middle.min()} "
        f"({'; '.join(least)}){''.join(others)}."
    )


def _middle(trials: pd.Series, q: float = 0.5) -> int:
    return int(np.quantile(trials, q, method="inverted_cdf"))


def _best(choices: pd.DataFrame) -> list[str]:
    """The row with the least regret in each group, T, and chance."""
    lines = ["Least mean regret:", ""]
    usual = choices[choices["start"] == USUAL]
    for group, some in usual.groupby("group"):
        regret = (some["chosen"] - some["best"]).groupby(some["row"]).mean().sort_values()
        chance = (some["random"] - some["best"]).mean()
        least = [str(row) for row, value in regret.items() if value <= regret.iloc[0] + 1e-9]
        worse = ", worse than at random" if regret[T] > chance else ""
        own = "" if T in least else f"; {rounded(regret[T])} ({T}{worse})"
        lines.append(
            f"- {group}: {rounded(regret.iloc[0])} mm ({'; '.join(least)}){own}; "
            f"{rounded(chance)} (at random)."
        )
    return lines


def _starts(choices: pd.DataFrame) -> list[str]:
    lines = [
        "The same models, told the first state in each flight's own log. Where the beginning of "
        "the motion is not in the log, that state is in the middle of it. A flight's "
        f"own first state is all that {NO_GAINS} can rank by: from the usual start its predictions "
        "are all equal. "
        "Who chooses gains has no such state.",
        "",
    ]
    shown = []
    own = choices[(choices["group"] == MAIN) & choices["row"].isin(_own_rows(choices))]
    for (split, row), some in own.groupby(["split", "row"], sort=False):
        line = {"split": split, "row": row}
        for start, mine in some.groupby("start", sort=False):
            line[f"rank corr., {start} start"] = _over(mine["rho"])
            line[f"regret mm, {start} start"] = _regret(mine)
        shown.append(line)
    return [*lines, f"{MAIN}:", "", markdown(pd.DataFrame(shown))]


def _own_rows(choices: pd.DataFrame) -> list[str]:
    return choices[choices["start"] == OWN]["row"].unique().tolist()


def _gains(table: pd.DataFrame) -> list[str]:
    lines = [
        "Rank correlation of a gain with the error over the held-out experiments, flown and as "
        "predicted (below 0: more is better), of the gains with the strongest correlation in what "
        "was flown; and the mean of the gain over the three best, against the median of all. "
        "Values: how many the gain has in training (mean over splits): what was never varied "
        "there, no model can know. "
        "Gains that were only changed together stand together.",
    ]
    agree = []
    for (split, group), some in table.groupby(["split", "group"], sort=False):
        rho = some.pivot(index="gain", columns="row", values="rho")
        top = some.pivot(index="gain", columns="row", values="top")
        order = rho[FLOWN].abs().sort_values(ascending=False).index[:_N_GAINS]
        shown = []
        for gain in order:
            line: dict[str, object] = {"gain": gain}
            line |= {f"{row}: rank corr.": float(rho.loc[gain, row]) for row in TASTES}
            own = some[some["gain"] == gain]
            line["values"] = rounded(own["n_known"].mean())
            line["median"] = rounded(own["usual"].mean(), 3)
            line |= {f"best 3, {row}": rounded(top.loc[gain, row], 3) for row in TASTES}
            shown.append(line)
        agree.append({"split": split, "group": group} | _varied(some) | _agreement(rho))
        if group == MAIN:
            lines += ["", f"{group}, {split}:", "", markdown(pd.DataFrame(shown))]
    lines += ["", "Gains whose correlation with the error has the sign of the flown one:", ""]
    return [*lines, markdown(pd.DataFrame(agree))]


def _varied(some: pd.DataFrame) -> dict[str, str]:
    own = some[(some["row"] == FLOWN) & (some["n"] > 1)]
    counts = {"vary when held out": len(own), "of them in training": (own["n_known"] > 1).sum()}
    return {what: str(count) for what, count in counts.items()}


def _agreement(rho: pd.DataFrame) -> dict[str, str]:
    """Of how many gains a model's correlation has the sign of the flown one, by row."""
    known = rho.dropna(subset=[FLOWN])
    same = {row: np.sign(known[FLOWN]) == np.sign(known[row]) for row in TASTES[1:]}
    return {row: f"{int(which.sum())} of {len(known)}" for row, which in same.items()}


def _trials(tables: Tables) -> list[str]:
    hits, progress = tables["hits"], tables["progress"]
    lines = [
        f"Each repeat begins with {N_INITIAL} experiments at random, the same for all rows; then "
        "the model is fitted on what was tried, of this group alone, and the experiment that it "
        "likes best of the others is flown (looked up). A trial is an experiment with all its "
        "flights. Median over repeats, with the 66th and 95th percentile. As flown: the order of "
        "the human tuner, who had to invent these gains and could not choose among them. "
        f"{FAR.capitalize()}: the gains farthest from all tried ones, whatever was flown: where it "
        "does as well as a model, the best gains are merely the most unusual. Groups of which many "
        "experiments are as good as the best are left out.",
        "",
    ]
    shown = []
    for (group, row), own in hits.groupby(["group", "row"], sort=False):
        line = {"group": group, "row": row}
        for column, what in (("within", "within 5 % of the best"), ("best", "the best")):
            line[f"trials until {what}"] = _percentiles(own[column])
        at = progress[(progress["group"] == group) & (progress["row"] == row)].set_index("trial")
        for trial in (N_INITIAL, 8, 12, 20):
            # a group of fewer experiments is tried out by then
            shown_at = min(trial, int(at.index.max()))
            line[f"best mm, trial {trial}"] = rounded(at["median"][shown_at], 3)
        shown.append(line)
    lines += [markdown(pd.DataFrame(shown)), ""]
    return lines + [f"- {_fewest(own)}" for _, own in hits.groupby("group", sort=False)]


def _percentiles(values: pd.Series) -> str:
    middle, *high = (str(_middle(values, q)) for q in (0.5, 0.66, 0.95))
    return f"{middle} ({', '.join(high)})" if len(values) > 1 else middle
