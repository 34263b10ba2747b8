"""What the paper claims, and the stored results that speak for or against it.

Statements are the paper's, in our words; every number comes from a table.
"""

import numpy as np
import pandas as pd

from benchmarks.paper._claims import Claim, Comparison, compare, compare_seeds, number
from benchmarks.paper._command import Tables
from benchmarks.paper._tasks import TASKS
from benchmarks.paper.continuous_time import lost_between

Sources = dict[str, Tables]

#: Where a roll-out takes its actions from, as a condition reads.
ACTIONS = {"logged": "logged actions", "policy": "recomputed actions"}
# settings as a condition reads, and how they mark the name of a model
_SETTINGS = {"paper's settings": "", "tuned (our defaults)": " (ours)"}


def claims(sources: Sources) -> list[Claim]:
    """Every claim that the page judges."""
    return [
        long_horizons(sources),
        short_horizons(sources),
        beyond_training(sources),
        error_growth(sources),
        recomputed_actions(sources),
        ensembles(sources),
        trajectory_ensembles(sources),
        sample_efficiency(sources),
        reward_prediction(sources),
        data_types(sources),
        planning(sources),
        continuous_time(sources),
        duels_in_time(sources),
    ]


def _against_one_step(
    sources: Sources, window: str, models: str = "D PE LSTM C"
) -> list[Comparison]:
    """Error of every rolled-out model over that of T, task by task, in a window of horizons."""
    episodes = sources["horizon-error"]["episodes"]
    known = {(model, actions) for model, actions in zip(episodes["model"], episodes["actions"])}
    comparisons = []
    for task in TASKS:
        some = episodes[episodes["task"] == task]
        for how, mark in _SETTINGS.items():
            for actions, by in {**ACTIONS, "none": "no actions"}.items():
                for model in models.split():
                    if (model + mark, actions) not in known:
                        continue
                    comparisons.append(
                        compare(
                            some,
                            {"model": model + mark, "actions": actions},
                            {"model": "T" + mark},
                            window,
                            condition=f"{task}, {how}, {by}",
                            what=f"{model} / T",
                        )
                    )
    return comparisons


def _found(comparisons: list[Comparison], how: str, by: str) -> str:
    """The ratios of one kind of settings and actions, as a sentence says them."""
    parts = []
    for task in TASKS:
        some = [one for one in comparisons if one.condition == f"{task}, {how}, {by}"]
        names = ", ".join(f"{one.what.split(' ')[0]} {number(one.estimate)}" for one in some)
        parts.append(f"{task}: {names}")
    return "; ".join(parts)


def long_horizons(sources: Sources) -> Claim:
    comparisons = _against_one_step(sources, "long")
    return Claim(
        "Trajectory models are more accurate far ahead",
        "Beyond 50 steps T has a fifth to a tenth of the error of one-step models and LSTMs, "
        "which are given the logged actions.",
        comparisons,
        notes=[
            "Times T's error, with the paper's settings and logged actions, where it says 5 to 10: "
            + _found(comparisons, "paper's settings", "logged actions")
            + ". Cartpole is unstable without feedback: logged actions cannot correct the "
            "smallest error, and the roll-out leaves all data. With recomputed actions: "
            + _found(comparisons, "paper's settings", "recomputed actions")
            + "; tuned: "
            + _found(comparisons, "tuned (our defaults)", "recomputed actions")
            + "."
        ],
        figure="horizon-error/horizon-error-ours.png",
    )


def short_horizons(sources: Sources) -> Claim:
    return Claim(
        "Trajectory models are less accurate at short horizons",
        "Below 25 steps T is worse than one-step models.",
        [_inverted(one) for one in _against_one_step(sources, "short", "D PE")],
    )


def beyond_training(sources: Sources) -> Claim:
    return Claim(
        "Trajectory models keep their lead beyond the training length",
        "On test episodes longer than any training episode T remains more accurate than one-step "
        "models.",
        _against_one_step(sources, "beyond"),
    )


def error_growth(sources: Sources) -> Claim:
    """Growth is the error beyond the training length over that within it."""
    episodes = sources["horizon-error"]["episodes"]
    keys = ["task", "model", "actions", "seed"]
    middle = episodes.groupby(keys)[["long", "beyond"]].median().sort_index()

    def growth(task: str, model: str, actions: str) -> tuple[np.ndarray, np.ndarray]:
        some = middle.loc[task, model, actions]
        return some["beyond"].to_numpy(), some["long"].to_numpy()

    comparisons = []
    for task in TASKS:
        for how, mark in _SETTINGS.items():
            comparisons.append(
                compare_seeds(
                    *growth(task, "T" + mark, "none"),
                    condition=f"T stays: {task}, {how}",
                    what="T beyond / within",
                    same=True,
                )
            )
            for actions, by in ACTIONS.items():
                comparisons += [
                    compare_seeds(
                        *growth(task, model + mark, actions),
                        condition=f"one-step grows: {task}, {how}, {by}",
                        what=f"{model} beyond / within",
                    )
                    for model in (["D", "PE"] if not mark else ["D"])
                ]
    return Claim(
        "The error of one-step models keeps growing, that of trajectory models stays",
        "The error of a one-step model goes on growing with the number of steps; T's remains "
        "stable.",
        comparisons,
        notes=[
            "Ratios: median error beyond the training length over that from step 51 to the "
            "training length."
        ],
    )


def recomputed_actions(sources: Sources) -> Claim:
    episodes = sources["action-source"]["episodes"]
    comparisons = [
        compare(
            episodes[episodes["task"] == task],
            {"model": model, "actions": "policy"},
            {"model": model, "actions": "logged"},
            "long",
            condition=f"{task}, {how}",
            what=f"{model.removesuffix(' (ours)')}, recomputed / logged",
        )
        for task in TASKS
        for model, how in (("PE", "paper's settings"), ("D (ours)", "tuned (our defaults)"))
    ]
    return Claim(
        "Recomputing the actions makes one-step models worse",
        "Errors compound when the action is computed from the predicted state instead of being "
        "given; one-step models are therefore compared with recorded actions.",
        comparisons,
        figure="action-source/action-source.png",
    )


def ensembles(sources: Sources) -> Claim:
    episodes = sources["all-models"]["episodes"]
    return Claim(
        "One-step models: PE is better than P, P than DE, DE than D",
        "Probabilistic models are more accurate than deterministic ones, ensembles than single "
        "models.",
        [
            compare(
                episodes[episodes["task"] == task],
                {"model": worse, "actions": actions},
                {"model": better, "actions": actions},
                "long",
                condition=f"{better} better than {worse}, {task}, {by}",
                what=f"{worse} / {better}",
            )
            for better, worse in (("PE", "P"), ("P", "DE"), ("DE", "D"))
            for task in TASKS
            for actions, by in ACTIONS.items()
        ],
        figure="all-models/all-models.png",
    )


def trajectory_ensembles(sources: Sources) -> Claim:
    episodes = sources["all-models"]["episodes"]
    pairs = (("TE", "T", False), ("TPE", "TP", False), ("T", "TP", True))
    return Claim(
        "Trajectory models: ensembles help, probabilistic training does not",
        "TE is better than T and TPE than TP; TP is about as accurate as T.",
        [
            compare(
                episodes[episodes["task"] == task],
                {"model": other},
                {"model": better},
                "long",
                condition=f"{other} like {better}, {task}"
                if same
                else f"{better} better than {other}, {task}",
                what=f"{other} / {better}",
                same=same,
            )
            for better, other, same in pairs
            for task in TASKS
        ],
    )


def sample_efficiency(sources: Sources) -> Claim:
    errors, data = (sources["sample-efficiency"][name] for name in ("errors", "data"))
    still = float(sources["sample-efficiency"]["no-change"]["error"].median())
    pairs = {
        "paper's settings": [("D", "T"), ("PE", "T")],
        "tuned (our defaults)": [
            ("D (ours)", "T (ours)"),
            ("D (ours), clipped", "T (ours), clipped"),
        ],
    }
    comparisons = []
    for how, models in pairs.items():
        for actions, by in ACTIONS.items():
            for where in ("all of the grid", "cells where T beats no change"):
                for model, trajectory in models:
                    cells = (
                        errors if where.startswith("all") else _useful(errors, trajectory, still)
                    )
                    clipped = model.endswith("clipped")
                    comparisons.append(
                        compare_seeds(
                            *_grid_medians(cells, (model, actions), (trajectory, "none")),
                            condition=f"{how}{', states clipped' * clipped}, {by}, {where}",
                            what=f"{model.split(' ')[0]} / T, middle of the cells",
                        )
                    )
    return Claim(
        "Trajectory models need fewer and shorter episodes",
        "On a grid of few and short reacher episodes T predicts 100 steps substantially better "
        "than one-step models, because its labelled data grow with the square of the length.",
        comparisons,
        notes=[
            "Every fit takes the same number of gradient steps, not the paper's epochs. "
            f"The forecast that nothing changes has an error of {number(still)}; "
            + ", ".join(
                f"{name} beats it in {_n_cells(_useful(errors, name, still))} of "
                f"{_n_cells(errors)} cells"
                for name in ("T", "T (ours)", "T (ours), clipped")
            )
            + ". In the others T leads, where it does, because one-step models diverge.",
            _growth_of_data(errors, data),
        ],
        figure="sample-efficiency/sample-efficiency.png",
    )


def _n_cells(errors: pd.DataFrame) -> int:
    return len(errors[["length", "n_episodes"]].drop_duplicates())


def _useful(errors: pd.DataFrame, trajectory: str, still: float) -> pd.DataFrame:
    """Lines of the cells in which a trajectory model beats the forecast that nothing changes."""
    cells = ["length", "n_episodes"]
    middle = errors[errors["model"] == trajectory].groupby(cells)["error"].median()
    useful = middle[middle < still].index
    return errors[errors.set_index(cells).index.isin(useful)]


def _grid_medians(
    cells: pd.DataFrame, above: tuple[str, str], below: tuple[str, str]
) -> tuple[np.ndarray, np.ndarray]:
    """Median over cells of the ratio of two models, seed by seed; and ones to divide by."""
    index = ["seed", "length", "n_episodes"]
    a, b = (
        cells[(cells["model"] == model) & (cells["actions"] == actions)].set_index(index)["error"]
        for model, actions in (above, below)
    )
    middle = (a / b).groupby(level="seed").median().to_numpy()
    return middle, np.ones_like(middle)


def _growth_of_data(errors: pd.DataFrame, data: pd.DataFrame) -> str:
    """What twice the length does to the labelled data and to the errors."""
    longest, most = errors["length"].max(), errors["n_episodes"].max()
    half = longest // 2
    sizes = data[data["n_episodes"] == most].set_index("length")
    rows = {
        name: sizes[name].loc[longest] / sizes[name].loc[half] for name in ("pairs", "transitions")
    }
    at = errors[errors["n_episodes"] == most].set_index(["model", "actions", "length"])["error"]

    def falls(model: str, actions: str) -> str:
        return number(
            float(at.loc[model, actions, half].median() / at.loc[model, actions, longest].median())
        )

    return (
        f"From L = {half} to L = {longest} with {most} episodes the pairs (s_t, s_t+h) grow "
        f"{number(rows['pairs'])} times and the transitions {number(rows['transitions'])} times; "
        f"T's error falls by a factor {falls('T', 'none')} (ours: {falls('T (ours)', 'none')}), "
        f"that of D with recomputed actions by {falls('D', 'policy')} (ours: "
        f"{falls('D (ours)', 'policy')}). The pairs are not independent: they come from the same "
        "episodes."
    )


def reward_prediction(sources: Sources) -> Claim:
    rivals = {
        "paper": ["GP", "NN", "D, logged actions", "D, predicted actions"],
        "tuned": ["GP", "NN", "D, logged actions", "D, predicted actions", "C"],
    }
    titles = {"paper": "paper's settings", "tuned": "tuned on training episodes"}
    comparisons = []
    for task, records in sources["reward-table"].items():
        errors = records.set_index(["settings", "row", "seed"])["mean"].sort_index()
        for settings, rows in rivals.items():
            own = errors.loc[settings, "T"].to_numpy()
            comparisons += [
                compare_seeds(
                    errors.loc[settings, row].to_numpy(),
                    own,
                    condition=f"{task}, {titles[settings]}, against {row}",
                    what="mean squared error of the reward, over that of T",
                )
                for row in rows
            ]
    return Claim(
        "Trajectory models predict the reward of an episode best",
        "T has the least squared error of the episode's reward: 6 times (cartpole) and 14 times "
        "(reacher) less than the next best method.",
        comparisons,
        figure="reward-table/cartpole.png",
    )


def data_types(sources: Sources) -> Claim:
    pairs = sources["data-types"]["pairs"]
    comparisons, left_out = [], []
    for trained, tested in _OTHER_KINDS:
        some = pairs[(pairs["trained"] == trained) & (pairs["tested"] == tested)]
        still = pairs[(pairs["trained"] == "-") & (pairs["tested"] == tested)]
        with_still = pd.concat([some, still])
        held = (str(still["model"].iloc[0]), "none")
        for how, mark in _SETTINGS.items():
            own = compare_seeds(
                *_of_models(with_still, held, ("T" + mark, "none")),
                condition=f"T is of use: trained on {trained}, {how}",
                what=f"start state held / T, tested on {tested}",
            )
            comparisons.append(own)
            if own.verdict != "for":
                left_out.append(f"{trained} to {tested} ({how})")
                continue
            comparisons += [
                compare_seeds(
                    *_of_models(some, ("D" + mark, actions), ("T" + mark, "none")),
                    condition=f"T beats D: trained on {trained}, {how}, {by}",
                    what=f"D / T, tested on {tested}",
                )
                for actions, by in ACTIONS.items()
            ]
    return Claim(
        "Trajectory models generalise across kinds of data",
        "Trained on unstable or periodic data T also predicts the other kinds, where one-step "
        "models diverge. (Trained on stable data both are said to be similar; one-step models "
        "trained and tested on unstable data are exempt.)",
        comparisons,
        notes=[
            "Unstable: without limits, as the paper's code comes to have it; survivors: unstable "
            "gains redrawn until an episode stays within the limits. Where T does not beat the "
            "forecast that the start state is held, nothing is gained by beating D, and the pair "
            f"is left out of that comparison: {', '.join(left_out) or 'none'}."
        ],
        figure="data-types/data-types-unstable.png",
    )


#: Kinds of data that a model is trained on and tested on: those that the claim is about.
_OTHER_KINDS = [
    ("periodic", "stable"),
    ("periodic", "unstable"),
    ("periodic", "survivors"),
    ("unstable", "stable"),
    ("unstable", "periodic"),
    ("survivors", "stable"),
    ("survivors", "periodic"),
]


def _of_models(
    lines: pd.DataFrame, above: tuple[str, str], below: tuple[str, str]
) -> tuple[np.ndarray, np.ndarray]:
    """Error far ahead of two models, seed by seed."""
    by_model = lines.set_index(["model", "actions", "seed"])["long"].sort_index()
    return by_model.loc[above].to_numpy(), by_model.loc[below].to_numpy()


def planning(sources: Sources) -> Claim:
    seconds = sources["audit"]["planning"]
    by_way = seconds.set_index(["way", "candidates", "seed"])["seconds"].sort_index()
    return Claim(
        "Planning is cheaper with one evaluation than with a roll-out",
        "Evaluating all horizons at once spares the sequential steps of a roll-out and can "
        "raise the rate of planning dramatically.",
        [
            compare_seeds(
                by_way.loc["one-step", n].to_numpy(),
                by_way.loc[way, n].to_numpy(),
                condition=f"candidates: {n}, {way.partition(', ')[2] or 'every horizon'}",
                what="seconds of one-step / seconds of T",
            )
            for n in seconds["candidates"].unique()
            for way in ("T", "T, every 10th horizon")
        ],
        notes=[
            "Bare networks of the same size in plain torch on one CPU thread, 200 steps; this "
            "library's overhead is not in these numbers (see benchmarks/speed)."
        ],
    )


#: One-step models of an uneven or thinned log that are asked between its times, as a rival of T.
_RIVALS = {
    "irregular": {
        "C with the time step": ("C with dt (ours)", "none", "long steps"),
        "D with the time step, recomputed": ("D with dt (ours)", "policy", "long steps"),
    },
    "regular": {
        "C, straight lines between steps": ("C (ours)", "none", "linear"),
        "D, recomputed, straight lines between steps": ("D (ours)", "policy", "linear"),
    },
}


def continuous_time(sources: Sources) -> Claim:
    comparisons = []
    for where, asked, places in _conditions_in_time(sources):
        lost = lost_between(places, "T (ours)")
        comparisons.append(
            Comparison(
                f"{where}: between the times of a regular log",
                "T off the grid / on it",
                lost.middle,
                np.nan,
                np.nan,
                (lost.low, lost.high),
                same=True,
            )
        )
        comparisons.append(
            compare_seeds(
                *(_every_step(asked, (log, *_T_ASKED)) for log in ("irregular", "regular")),
                condition=f"{where}: learning from irregular times",
                what="T of the irregular log / of the regular one",
                same=True,
            )
        )
    return Claim(
        "Trajectory models work in continuous time",
        "T is agnostic to discrete or continuous time: it can learn from data at any horizon and "
        "interpolate between them. (Not tested in the paper.)",
        comparisons,
        notes=[
            "Tuned models (our defaults). Errors between the times of a log are set against those "
            "on them, corrected for the times."
        ],
        figure="continuous-time/continuous-time.png",
    )


def duels_in_time(sources: Sources) -> Claim:
    return Claim(
        "Trajectory models beat one-step models between the times of a log",
        "Not claimed, but what the claim before invites to believe.",
        [
            compare_seeds(
                _every_step(asked, (log, *rival)),
                _every_step(asked, (log, *_T_ASKED)),
                condition=f"{where}, {log} log, against {name}",
                what=f"{name.split(',')[0]} / T",
            )
            for where, asked, _ in _conditions_in_time(sources)
            for log, rivals in _RIVALS.items()
            for name, rival in rivals.items()
        ],
        notes=["Tuned models (our defaults) of the same log, asked for every control step."],
    )


_T_ASKED = ("T (ours)", "none", "direct")


def _conditions_in_time(sources: Sources) -> list[tuple[str, pd.DataFrame, pd.DataFrame]]:
    """Name, errors by what was asked, and errors by distance from the grid."""
    tables = sources["continuous-time"]
    keys = ["task", "interval"]
    places = dict(iter(tables["distances"].groupby(keys, sort=False)))
    return [
        (f"{key[0]}, a state every {key[1]:g} s", asked, places[key])
        for key, asked in tables["asked"].groupby(keys, sort=False)
    ]


def _every_step(asked: pd.DataFrame, line: tuple[str, str, str, str]) -> np.ndarray:
    """Error of a model at every control step, by seed."""
    some = asked[asked["asked"] == "every step"]
    by_line = some.set_index(["log", "model", "actions", "way", "seed"])["median"].sort_index()
    return by_line.loc[line].to_numpy()


def _inverted(one: Comparison) -> Comparison:
    """The reciprocal ratio, for a claim that T is worse."""
    a, _, b = one.what.partition(" / ")
    with np.errstate(divide="ignore"):
        estimate, high, low, *seeds = 1 / np.array([one.estimate, one.low, one.high, *one.seeds])
    return Comparison(one.condition, f"{b} / {a}", estimate, low, high, tuple(seeds), one.same)
