"""Unevenly logged data, and predictions at times that no log has.

The paper says in section III that T is agnostic to discrete or continuous time, as it can use
data at any h, and does not test it. Here the controller acts at every control step, but the log
keeps one state in four (or ten) on average: at random gaps ("irregular") or on a grid ("regular",
as many states). Test episodes are asked for at every control step, at fresh irregular times, at
twice the rate of the log, and on its grid.

- T takes any horizon and is asked directly. Between the times of a regular log its error is set
  against that on them, and against straight lines between its own predictions on them.
- One-step models of a regular log are rolled out on its grid, with straight lines in between.
- One-step models of an irregular log have the time step as an input. "direct" rolls them out in
  steps as short as asked; "long steps" takes one step of any length and then steps of the mean
  interval, so that few errors add up.

C sees (s, theta) and is the fair one-step form. D sees the action logged at the beginning of a
gap, which the controller did not hold until the end of it: D is handicapped by construction.
Models of the full log, with every control step, show what logging fast would have given.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import (
    ERROR,
    draw_curve,
    horizon_axes,
    legend_below,
    over_seeds,
    share_y,
)
from benchmarks.paper._models import label
from benchmarks.paper._rollouts import N_TEST
from benchmarks.paper._tasks import N_EPISODES, TASKS, environment
from benchmarks.paper._uneven_logs import ASKED, LONGEST_GAP, PARTS, System, cell
from trajlearn.plotting._style import GREY, line_style, tidy

#: Tasks with the mean number of control steps from one logged state to the next.
CONDITIONS = {
    "full": [("cartpole", 4), ("cartpole", 10), ("reacher", 10)],
    "quick": [("cartpole", 4), ("reacher", 10)],
}
#: "true states" is no model: it shows how much is lost by lines between grid times alone.
SYSTEMS = [
    System("T", "default", "irregular"),
    System("T", "paper", "irregular"),
    System("C with dt", "default", "irregular"),
    System("D with dt", "default", "irregular"),
    System("T", "default", "regular"),
    System("T", "paper", "regular"),
    System("C", "default", "regular"),
    System("D", "default", "regular"),
    System("true states", "paper", "regular"),
    System("T", "default", "full"),
    System("C", "default", "full"),
    System("D", "default", "full"),
]
#: What identifies a line of the tables, beside the condition and the seed.
LINE = ["log", "model", "actions", "way"]


# -- tables -------------------------------------------------------------------------------


def run(run: Run) -> Tables:
    """Errors by what was asked, over time, and by the distance from the grid."""
    cells = [
        {"task": task, **system._asdict(), "interval": k, "mode": run.mode, "seed": seed}
        for task, k in CONDITIONS[run.mode]
        for system in SYSTEMS
        for seed in run.seeds
    ]
    tables: dict[str, list[pd.DataFrame]] = {"asked": [], "curves": [], "distances": []}
    for key, results in zip(cells, run.cells(cells, cell), strict=True):
        k, dt = key["interval"], environment(key["task"]).dt
        head = {"task": key["task"], "interval": k * dt, "log": key["log"]}
        head["model"] = label(key["model"], key["settings"])
        for some in results:
            line = head | {"actions": some["actions"], "way": some["way"], "seed": key["seed"]}
            asked = pd.DataFrame(line | some["asked"]).rename(columns={"of": "asked"})
            tables["asked"].append(asked)
            # the middle of each interval
            times = (np.array(some["curve"]["of"]) - (k - 1) / 2) * dt
            values = {"time": times, "median": some["curve"]["median"]}
            tables["curves"].append(pd.DataFrame(line | values))
            part, steps = zip(*(name.split(":") for name in some["distance"]["of"]), strict=True)
            values = {"part": part, "distance": np.array(steps, dtype=int) * dt}
            values["median"] = some["distance"]["median"]
            tables["distances"].append(pd.DataFrame(line | values))
    return {name: pd.concat(parts, ignore_index=True) for name, parts in tables.items()}


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "conditions": CONDITIONS[mode],
        "systems": SYSTEMS,
        "n_train": N_EPISODES,
        "n_test": N_TEST[mode],
        "steps": {task: shape.length for task, shape in TASKS.items()},
        "longest_gap": LONGEST_GAP,
    }


# -- text ---------------------------------------------------------------------------------

OURS = ("irregular", "T (ours)", "none", "direct")
OURS_ON_GRID = ("regular", "T (ours)", "none", "direct")
FULL_T = ("full", "T (ours)", "none", "direct")


class Ratio(NamedTuple):
    """One error over another: median, least and greatest over seeds."""

    middle: float
    low: float
    high: float

    @classmethod
    def of(cls, above: pd.Series, below: pd.Series) -> "Ratio":
        """Ratio of two series by seed; NaN where both are infinite for some seed."""
        values = (above / below).to_numpy()
        return cls(float(np.median(values)), float(values.min()), float(values.max()))

    def __str__(self) -> str:
        return f"{self.middle:.2g}" + _spread(self.low, self.high)

    def word(self, less: str, same: str, more: str) -> str:
        """What it says where all seeds say it, and by more than a tenth."""
        return less if self.high < 0.9 else more if self.low > 1.1 else same


def _spread(low: float, high: float) -> str:
    return "" if low == high else f" ({low:.2g} to {high:.2g})"


def _lookup(table: pd.DataFrame, columns: list[str]) -> Callable[..., pd.Series]:
    """Function from the values of some columns to the median error by seed."""
    indexed = table.set_index([*columns, "seed"])["median"].sort_index()
    return lambda *values: indexed.loc[values]


def report(tables: Tables) -> str:
    """What follows from the errors, and their medians with the spread over seeds."""
    keys = ["task", "interval"]
    places = dict(iter(tables["distances"].groupby(keys, sort=False)))
    text: list[str] = []
    unseen, duels = [], []
    for key, asked in tables["asked"].groupby(keys, sort=False):
        name = f"{key[0]}, {key[1]:g} s"
        for model in ("T (ours)", "T"):
            ratio = lost_between(places[key], model)
            loses = ratio.word("less than nothing", "nothing", "something")
            unseen.append(f"- {model}, {name}: {loses}, {ratio}.")
        contest = _contest(asked)
        duels.append(name + ", " + contest["log"] + " log, " + contest["against"])
        duels[-1].index = contest["verdict"]
        text += [f"### {name} from one logged state to the next, on average", ""]
        text += [f"- {sentence}" for sentence in _sentences(asked, places[key])]
        text += ["", "T (ours) over the best one-step model of the same log:", ""]
        text += [markdown(contest.drop(columns="verdict")), ""]
        text += ["Errors:", "", markdown(_errors(asked)), ""]
    lines = ["What T loses half an interval off the grid of its log (its error over that on the"]
    lines += ["grid, in intervals 2 to 5, over the same ratio of T of the irregular log):", ""]
    lines += [*unseen, ""]
    lines += [
        "T (ours) against the best one-step model of the same log, at every control step:",
        "",
    ]
    outcomes = pd.concat(duels)
    for word in ("wins", "draws", "loses"):
        some = outcomes[outcomes.index == word].tolist()
        lines.append(f"- T (ours) {word}: {'; '.join(some) or 'nowhere'}.")
    return "\n".join([*lines, "", *_ABOUT, "", *text])


_ABOUT = [
    "Squared error in ranges of the training states, averaged over the times asked for: median",
    "over test episodes, then median over seeds (least to greatest). Every log but the full one",
    "keeps the same number of states. (ours) means the library's defaults, otherwise the paper's",
    'settings. "+n" counts forecasts that diverged (infinite error), over all seeds. Words such as',
    '"wins" and "better" need all seeds to agree, and more than a tenth.',
]


def lost_between(places: pd.DataFrame, model: str) -> Ratio:
    """Error of T off the grid over that on it, past the first interval; 1 if nothing is lost.

    The times on the grid and off it differ, and the error changes with time: T of the irregular
    log, which knows no grid, says how much that makes.
    """
    at = _lookup(places, [*LINE, "part", "distance"])
    far = places["distance"].max()
    _, soon, _ = PARTS
    lines = [(log, model, "none", "direct") for log in ("regular", "irregular")]
    own, other = (at(*line, soon, far) / at(*line, soon, 0.0) for line in lines)
    return Ratio.of(own, other)


def _sentences(asked: pd.DataFrame, places: pd.DataFrame) -> list[str]:
    """What else the tables of one condition say."""
    errors = _lookup(asked, [*LINE, "asked"])
    at = _lookup(places, [*LINE, "part", "distance"])
    first, soon, _ = PARTS
    far = places["distance"].max()
    lines = (*OURS_ON_GRID[:3], "linear")
    ours = errors(*OURS, "every step")
    before = Ratio.of(at(*OURS_ON_GRID, first, far), at(*OURS, first, far))
    drawn, drawn_first = (
        Ratio.of(at(*OURS_ON_GRID, part, far), at(*lines, part, far)) for part in (soon, first)
    )
    better = drawn.word("better than", "no different from", "worse than")
    even = Ratio.of(ours, errors(*OURS_ON_GRID, "every step"))
    sentences = [
        f"Half an interval off the grid, T (ours) of the regular log is {better} straight lines "
        f"between its own predictions on the grid in intervals 2 to 5: {drawn} times their error; "
        f"in interval 1: {drawn_first}.",
        "In the middle of interval 1, a horizon shorter than any in the regular log, T (ours) of "
        f"it has {before} times the error of T (ours) of the irregular log.",
        f"For T (ours) irregular gaps are {even.word('better than', 'as good as', 'worse than')} "
        f"a grid: {even} times its error at every step. Against T (ours) of the full log: "
        f"{Ratio.of(ours, errors(*FULL_T, 'every step'))}.",
    ]
    for model, actions in (("C", "none"), ("D", "policy")):
        line = ("irregular", f"{model} with dt (ours)", actions)
        short, long = (errors(*line, way, "every step") for way in ("direct", "long steps"))
        full = errors("full", f"{model} (ours)", actions, "direct", "every step")
        how = ", recomputed actions," if actions == "policy" else ""
        sentences.append(
            f"{model} with dt{how} asked for every step has {Ratio.of(short, long)} times the "
            f"error in short steps that it has in long ones. T (ours) of the irregular log over "
            f"{model} of the full log: {Ratio.of(ours, full)}."
        )
    return sentences


def _contest(asked: pd.DataFrame) -> pd.DataFrame:
    """T (ours) over the best one-step model of each log, with and without knowing the policy.

    The rival is the best on the test episodes themselves, which favours it.
    """
    errors, rows = _lookup(asked, [*LINE, "asked"]), []
    for line in (OURS, OURS_ON_GRID):
        for against, letters in (("all", "CD"), ("those that know no policy", "C")):
            row = {"log": line[0], "against": against}
            rivals = asked[(asked["log"] == line[0]) & asked["model"].str[0].isin(list(letters))]
            for name in ASKED:
                own = rivals[rivals["asked"] == name]
                best: Any = own.groupby(LINE)["median"].median().idxmin()
                ratio = Ratio.of(errors(*line, name), errors(*best, name))
                row[name] = f"{ratio}: {_name(best[1:])}"
                row.setdefault("verdict", ratio.word("wins", "draws", "loses"))
            rows.append(row)
    return pd.DataFrame(rows)


def _name(line: tuple[str, ...]) -> str:
    return ", ".join(word for word in line if word != "none")


def _errors(asked: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for line, some in asked.groupby(LINE, sort=False):
        row = dict(zip(LINE, line, strict=True))
        for name in ASKED:
            own = some[some["asked"] == name]
            values, gone = own["median"], int(own["n_diverged"].sum())
            row[name] = f"{values.median():.2g}" + _spread(values.min(), values.max())
            row[name] += f" +{gone}" if gone else ""
        rows.append(row)
    return pd.DataFrame(rows)


# -- figures ------------------------------------------------------------------------------

#: Lines of the figure over time: model, actions, way, and the style they share between logs.
SHOWN = [
    ("T (ours)", "none", "direct", "T (ours)"),
    ("T", "none", "direct", "T (paper's settings)"),
    ("C with dt (ours)", "none", "long steps", "C"),
    ("C (ours)", "none", "linear", "C"),
    ("C (ours)", "none", "direct", "C"),
    ("D with dt (ours)", "policy", "long steps", "D, recomputed actions"),
    ("D (ours)", "policy", "linear", "D, recomputed actions"),
    ("D (ours)", "policy", "direct", "D, recomputed actions"),
    ("D with dt (ours)", "logged", "long steps", "D, logged actions"),
    ("D (ours)", "logged", "linear", "D, logged actions"),
    ("D (ours)", "logged", "direct", "D, logged actions"),
    ("C with dt (ours)", "none", "direct", "C, in short steps"),
    ("D with dt (ours)", "policy", "direct", "D, recomputed actions, in short steps"),
    ("true states", "none", "linear", "true states, straight lines"),
]
LOGS = {
    "irregular": "irregular log; C and D with dt, in long steps",
    "regular": "regular log; C and D with straight lines",
    "full": "full log",
}
#: Lines of the figure by distance.
PLACES = [
    (*OURS_ON_GRID, "T (ours), regular log"),
    (*OURS_ON_GRID[:3], "linear", "the same, straight lines"),
    ("regular", "T", "none", "direct", "T (paper's settings), regular log"),
    (*OURS, "T (ours), irregular log"),
    ("regular", "C (ours)", "none", "linear", "C, regular log, straight lines"),
    ("regular", "true states", "none", "linear", "true states, straight lines"),
]
#: Limits of the error in figures; the tables have all values.
FLOOR, CEILING = 1e-8, 1e2


def draw(tables: Tables) -> dict[str, Any]:
    """Error over time, by what was asked, and by the distance from the grid."""
    return {
        "continuous-time": _draw_curves(tables["curves"]),
        "continuous-time-asked": _draw_asked(tables["asked"]),
        "continuous-time-distance": _draw_distances(tables["distances"]),
    }


def _conditions(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    groups = table.groupby(["task", "interval"], sort=False)
    return [(f"{task}, log of {interval:g} s", some) for (task, interval), some in groups]


def _panels(n_rows: int, conditions: list[Any], height: float) -> Any:
    import matplotlib.pyplot as plt

    size = (4.2 * len(conditions), height * n_rows + 0.8)
    return plt.subplots(n_rows, len(conditions), figsize=size, layout="constrained", squeeze=False)


def _draw_curves(curves: pd.DataFrame) -> Any:
    conditions = _conditions(curves)
    figure, grid = _panels(len(LOGS), conditions, 2.9)
    names = list(dict.fromkeys(name for *_, name in SHOWN))
    for column, (title, some) in zip(grid.T, conditions, strict=True):
        for ax, (log, about) in zip(column, LOGS.items(), strict=True):
            # one entry of the legend for each style, in the first panel
            for i, name in enumerate(names if ax is grid[0, 0] else []):
                empty = pd.DataFrame({"horizon": [np.nan], "middle": [np.nan]})
                draw_curve(ax, empty, i, name, band=None)
            for *line, name in SHOWN:
                own = some[(some[LINE] == [log, *line]).all(axis=1)]
                if len(own):
                    curve = over_seeds(own, ["time"]).rename(columns={"time": "horizon"})
                    curve = curve[curve["middle"] > FLOOR]
                    draw_curve(ax, curve, names.index(name), "_", band=("low", "high"))
            horizon_axes(ax, title=f"{title}\n{about}", unit="s")
        share_y(column)
    legend_below(figure, grid[0, 0], ncols=4)
    return figure


def _draw_asked(asked: pd.DataFrame) -> Any:
    import matplotlib.pyplot as plt

    conditions = _conditions(asked)
    lines = list(asked[LINE].drop_duplicates().itertuples(index=False, name=None))
    size = (3 + 3.3 * len(conditions), 0.34 * len(lines) + 1.4)
    figure, axes = plt.subplots(
        1, len(conditions), figsize=size, layout="constrained", sharey=True, squeeze=False
    )
    for ax, (title, some) in zip(axes[0], conditions, strict=True):
        for j, (name, marker) in enumerate(zip(ASKED, "os^D", strict=True)):
            own = over_seeds(some[some["asked"] == name], LINE).set_index(LINE).loc[lines]
            own = own.clip(upper=CEILING)
            height = np.arange(len(lines)) + 0.18 * (j - 1.5)
            style: dict[str, Any] = {"color": line_style(j)["color"]}
            ax.hlines(height, own["low"], own["high"], lw=1.2, **style)
            ax.plot(own["middle"], height, marker, ms=4, mfc="white", label=name, **style)
            if name == ASKED[0]:
                ax.axvline(own.loc[OURS, "middle"], color=GREY, lw=1, ls="dotted")
        ax.set_xscale("log", nonpositive="mask")
        ax.set_xlim(left=max(ax.get_xlim()[0], FLOOR))
        ax.set_ylim(len(lines) - 0.4, -0.6)
        ax.grid(axis="y", lw=0.3)
        ax.set_title(title, loc="left", fontsize=10)
        ax.set_xlabel(f"{ERROR}\n(at {CEILING:g}: that or more)")
        tidy(ax)
    labels = [f"{line[0]}: {_name(line[1:])}" for line in lines]
    axes[0, 0].set_yticks(range(len(lines)), labels, fontsize=8)
    legend_below(figure, axes[0, 0], ncols=4)
    return figure


def _draw_distances(places: pd.DataFrame) -> Any:
    conditions = _conditions(places)
    figure, grid = _panels(len(PARTS), conditions, 2.9)
    for column, (title, some) in zip(grid.T, conditions, strict=True):
        for ax, part in zip(column, PARTS, strict=True):
            for i, (*line, name) in enumerate(PLACES):
                own = some[(some["part"] == part) & (some[LINE] == line).all(axis=1)]
                curve = over_seeds(own, ["distance"]).rename(columns={"distance": "horizon"})
                curve = curve[curve["middle"] > FLOOR].sort_values("horizon")
                draw_curve(ax, curve, i, name, band=("low", "high"))
                ax.lines[-1].set_markevery(1)
            horizon_axes(ax, title=f"{title}: {part}")
            # three decades: lines far below do not matter
            top = ax.get_ylim()[1]
            ax.set_ylim(top / 1e3, top)
            ax.set_xlabel("distance from the nearest grid time (s)")
    legend_below(figure, grid[0, 0], ncols=3)
    return figure


BENCHMARK = Benchmark("continuous-time", __doc__, run, report, draw, settings, minutes=8)

if __name__ == "__main__":
    BENCHMARK.main()
