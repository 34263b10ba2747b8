"""Claims about data: how much of it is needed, what is made of rewards, and other kinds of it."""

import numpy as np
import pandas as pd

from benchmarks.paper._claims import ACTIONS, SETTINGS, Claim, Sources, compare_seeds, number

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
                            _grid_medians(cells, (model, actions), (trajectory, "none")),
                            1.0,
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
) -> np.ndarray:
    """Median over cells of the ratio of two models, seed by seed."""
    index = ["seed", "length", "n_episodes"]
    a, b = (
        cells[(cells["model"] == model) & (cells["actions"] == actions)].set_index(index)["error"]
        for model, actions in (above, below)
    )
    return (a / b).groupby(level="seed").median().to_numpy()


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
        "tuned": [
            *("GP", "NN", "D, logged actions", "D, predicted actions"),
            *("D, polynomial, predicted actions", "C"),
        ],
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
        notes=[
            "D, polynomial: ridge regression on polynomial features. The cartpole's equations are "
            "nearly polynomial within its limits, so that it is a baseline made for it."
        ],
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
        for how, mark in SETTINGS.items():
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


def _of_models(
    lines: pd.DataFrame, above: tuple[str, str], below: tuple[str, str]
) -> tuple[np.ndarray, np.ndarray]:
    """Error far ahead of two models, seed by seed."""
    by_model = lines.set_index(["model", "actions", "seed"])["long"].sort_index()
    return by_model.loc[above].to_numpy(), by_model.loc[below].to_numpy()
