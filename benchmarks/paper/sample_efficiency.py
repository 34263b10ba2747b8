"""How little data will do: reacher models from fewer and shorter episodes.

A grid of episodes N by steps L, nested as a user's data would grow, with the paper's settings
and the library's defaults, every fit of 1,000 gradient steps. Median over test episodes of 100
steps of the mean error over all of them, in one range for the whole grid; beside it the forecast
that nothing changes. (The paper: its figure of sample efficiency.)
"""

import warnings
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.paper._command import Benchmark, Run, Tables, markdown
from benchmarks.paper._figures import GREY, over_seeds, tidy
from benchmarks.paper._models import build, label
from benchmarks.paper._rollouts import action_sources
from trajlearn import Reacher, SubtrajectoryRelabeler, TrajectoryDataset, paper
from trajlearn.exceptions import DivergenceWarning, HorizonWarning
from trajlearn.plotting._style import line_style

Floats = NDArray[np.float64]

MODELS = [("D", "paper"), ("PE", "paper"), ("T", "paper"), ("D", "default"), ("T", "default")]
LENGTHS = {"full": [5, 10, 20, 35, 50, 75, 100], "quick": [5, 20, 50, 100]}
COUNTS = {"full": [1, 2, 4, 7, 10, 15, 20], "quick": [1, 4, 20]}
N_STEPS = {"full": 1000, "quick": 300}
N_TEST = {"full": 50, "quick": 20}
TEST_LENGTH = 100
#: Forecasts of our defaults are also shown with states held within this many training ranges.
CLIP = 1.2
#: Episodes whose range is the unit of all errors; their seed is no other's.
N_REFERENCE, REFERENCE_SEED = 100, 1_000_000

_CLIPPED = ", clipped"
_SOURCES = {"logged": "logged actions", "policy": "recomputed actions", "none": ""}
_OUR_D, _OUR_T = label("D", "default"), label("T", "default")
#: What tables and figures show: (model, actions).
PAPER = [(model, how) for model in ("D", "PE") for how in ("logged", "policy")] + [("T", "none")]
OURS = [
    (_OUR_D, "logged"),
    (_OUR_D, "policy"),
    (_OUR_D + _CLIPPED, "policy"),
    (_OUR_T, "none"),
    (_OUR_T + _CLIPPED, "none"),
]
#: Trajectory models, and the one-step models that each is compared with.
DUELS = {
    "T": PAPER[:-1],
    _OUR_T: OURS[:2],
    _OUR_T + _CLIPPED: [(_OUR_D + _CLIPPED, how) for how in ("logged", "policy")],
}
# greatest error that the colours tell apart
_CEILING = 0.3
_SHORT = {"none": "", "logged": " l", "policy": " r"}


# -- measuring --------------------------------------------------------------------------------


def episodes(seed: int, *, n_test: int) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """The most training episodes of any cell, and test episodes, for a seed."""
    env = Reacher()
    train = env.collect(max(COUNTS["full"]), max(LENGTHS["full"]), random_state=2 * seed)
    return train, env.collect(n_test, TEST_LENGTH, random_state=2 * seed + 1)


def reference_width() -> Floats:
    """Range of each state over episodes of their own: the unit of every error."""
    reference = Reacher().collect(N_REFERENCE, TEST_LENGTH, random_state=REFERENCE_SEED)
    return np.ptp(reference.states, axis=0)


def episode_errors(predicted: Floats, test: TrajectoryDataset, width: Floats) -> Floats:
    """Squared error of each episode and horizon (n, H), averaged over states."""
    truth = np.stack([episode.states[1:] for episode in test])
    return (((predicted - truth) / width) ** 2).mean(axis=2)


def summary(errors: Floats, length: int) -> dict[str, float]:
    """Medians over episodes of the mean error over horizons, all of them and parts.

    ``first`` is the first step, ``within`` the horizons up to the training length and ``beyond``
    the others. An episode that diverged is infinite.
    """
    parts = {"error": slice(None), "first": slice(1), "within": slice(length)}
    if length < errors.shape[1]:
        parts["beyond"] = slice(length, None)
    means = {name: errors[:, where].mean(axis=1) for name, where in parts.items()}
    values = {name: float(np.median(mean)) for name, mean in means.items()}
    return {"beyond": float("nan")} | values | {"n_diverged": int(np.isinf(errors[:, -1]).sum())}


def cell(
    model: str,
    settings: str,
    n_episodes: int,
    lengths: list[int],
    n_steps: int,
    n_test: int,
    seed: int,
) -> list[dict[str, Any]]:
    """One model fitted on the beginnings of `n_episodes` episodes, for every length."""
    train, test = episodes(seed, n_test=n_test)
    width = reference_width()
    lines = []
    for length in lengths:
        estimator = build(model, settings, policy=Reacher().policy, mode="full", seed=seed)
        estimator.set_params(estimator__max_steps=n_steps, estimator__max_epochs=None)
        estimator.fit(train[:n_episodes].truncate(length))
        for clip in (None, CLIP) if settings == "default" else (None,):
            for actions in action_sources(model):
                predicted = forecast(estimator, test, actions, clip=clip)
                name = label(model, settings) + (_CLIPPED if clip else "")
                key = {"model": name, "actions": actions, "length": length}
                lines.append(key | summary(episode_errors(predicted, test, width), length))
    return lines


def forecast(
    estimator: Any, test: TrajectoryDataset, actions: str, *, clip: float | None
) -> Floats:
    """Predicted states (n, H, d_s), held near the training states if asked.

    A one-step model is held at every step of its roll-out, a trajectory model afterwards.
    """
    asked = {} if actions == "none" else {"actions": actions}
    if actions != "none":
        estimator.set_params(clip_states=clip)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DivergenceWarning)
        warnings.simplefilter("ignore", HorizonWarning)
        predicted = np.asarray(estimator.predict(test, **asked))
    if clip is None:
        return predicted
    low, high = estimator.state_range_
    centre, reach = (low + high) / 2, clip * (high - low) / 2
    return np.clip(predicted, centre - reach, centre + reach)


def no_change(seed: int, *, lengths: list[int], n_test: int) -> pd.DataFrame:
    """Errors of the forecast that every state stays as it began."""
    _, test = episodes(seed, n_test=n_test)
    starts = np.stack([episode.states[:1] for episode in test])
    errors = episode_errors(starts, test, reference_width())
    lines = [{"seed": seed, "length": length} | summary(errors, length) for length in lengths]
    return pd.DataFrame(lines).drop(columns="n_diverged")


def data_sizes(lengths: list[int], counts: list[int]) -> pd.DataFrame:
    """Labelled rows of each cell, and the gradient steps of the paper's epochs on them."""
    train, _ = episodes(0, n_test=1)
    lines = []
    for length in lengths:
        for n in counts:
            ds = train[:n].truncate(length)
            pairs = SubtrajectoryRelabeler().n_pairs(ds)
            line = {"length": length, "n_episodes": n}
            line |= {"transitions": int(ds.lengths.sum()), "pairs": pairs}
            trajectory = paper.model("T")
            rows = {"D": line["transitions"], "T": min(pairs, trajectory.relabeler.max_rows)}
            for model, count in rows.items():
                learner = paper.model(model).estimator
                line[f"epochs_{model}"] = learner.max_epochs * -(-count // learner.batch_size)
            lines.append(line)
    return pd.DataFrame(lines)


def run(run: Run) -> Tables:
    """Errors by model, actions, length, episodes and seed; no change; amounts of data."""
    lengths, counts = LENGTHS[run.mode], COUNTS[run.mode]
    sizes = {"lengths": lengths, "n_steps": N_STEPS[run.mode], "n_test": N_TEST[run.mode]}
    cells = [
        {"model": model, "settings": settings, "n_episodes": n, "seed": seed} | sizes
        for seed in run.seeds
        for model, settings in MODELS
        for n in counts
    ]
    tables = []
    for asked, lines in zip(cells, run.cells(cells, cell), strict=True):
        key = {"seed": asked["seed"], "n_episodes": asked["n_episodes"]}
        tables.append(pd.DataFrame([key | line for line in lines]))
    still = [no_change(s, lengths=lengths, n_test=sizes["n_test"]) for s in run.seeds]
    return {
        "errors": pd.concat(tables, ignore_index=True),
        "no-change": pd.concat(still, ignore_index=True),
        "data": data_sizes(lengths, counts),
    }


def settings(mode: str) -> dict[str, Any]:
    """What a reader of the numbers must know."""
    return {
        "models": MODELS,
        "lengths": LENGTHS[mode],
        "n_episodes": COUNTS[mode],
        "n_steps": N_STEPS[mode],
        "n_test": N_TEST[mode],
        "test_length": TEST_LENGTH,
        "clip_states": CLIP,
        "n_reference": N_REFERENCE,
    }


# -- report -----------------------------------------------------------------------------------


def report(tables: Tables) -> str:
    """Who wins where, what more data buys, and what was extrapolated."""
    errors, still, data = tables["errors"], tables["no-change"], tables["data"]
    longest, most = errors["length"].max(), errors["n_episodes"].max()
    at_longest = errors[errors["length"] == longest]
    at_most = errors[errors["n_episodes"] == most]
    unchanged = still.groupby("seed")["error"].first()
    baseline = float(unchanged.median())
    lines = [
        "Median over test episodes of the squared error, averaged over states and over all",
        f"{TEST_LENGTH} horizons, in units of the squared range of {N_REFERENCE} other episodes.",
        "Over seeds: median (least to greatest). Infinite where the median forecast diverges.",
        "The forecast that every state stays as it began has an error of",
        f'{_entry(unchanged)}. "Clipped": states held within {CLIP} times the training',
        "range, at every step of a roll-out, or in the finished forecast of T.",
        *_section("Labelled data", _data(data), *_budgets(data)),
        *_section(
            "The trajectory model against one-step models, all cells",
            _duels(errors),
            "The paper finds T better with both fewer and shorter episodes. Ratio: the error of",
            "the one-step model by that of T, above 1 where T is better.",
        ),
    ]
    for title, shown in (("the paper's settings", PAPER), ("our defaults", OURS)):
        lines += _section(
            f"Best model in each cell, {title}",
            _best(errors, shown, baseline),
            "l: logged, r: recomputed actions; in brackets where even the best is no better than",
            "the forecast that nothing changes.",
        )
    lines += _section(
        f"Error by number N of episodes of {longest} steps",
        _growth(at_longest, "n_episodes", "N", baseline),
    )
    lines += _section(
        f"Error by length L of {most} episodes", _growth(at_most, "length", "L", baseline)
    )
    lines += _section(
        f"Up to and beyond the training length L, {most} episodes",
        _extrapolation(at_most, still),
        "Beyond it T extrapolates in the horizon, a one-step model in the states that it meets.",
    )
    lines += _section(
        f"Error of the first step, {most} episodes of {longest} steps",
        _first_step(at_most, still),
        "How far the paper's small learning rates bring its one-step models in as many steps.",
    )
    return "\n".join(lines)


def _section(title: str, table: pd.DataFrame, *text: str) -> list[str]:
    paragraph = [*text, ""] if text else []
    return ["", f"### {title}", "", *paragraph, markdown(table)]


def _name(model: str, actions: str) -> str:
    return ", ".join(filter(None, [model, _SOURCES[actions]]))


def _pick(errors: pd.DataFrame, model: str, actions: str) -> pd.DataFrame:
    return errors[(errors["model"] == model) & (errors["actions"] == actions)]


def _entry(values: pd.Series) -> str:
    middle, low, high = values.median(), values.min(), values.max()
    spread = "" if len(values) == 1 else f" ({low:.2g} to {high:.2g})"
    return f"{middle:.2g}{spread}"


def _data(data: pd.DataFrame) -> pd.DataFrame:
    """Rows by length, for the fewest and the most episodes."""
    few, most = data["n_episodes"].min(), data["n_episodes"].max()
    columns = {}
    for n in (few, most):
        some = data[data["n_episodes"] == n].set_index("length")
        columns[f"transitions, N = {n}"] = some["transitions"]
        columns[f"pairs, N = {n}"] = some["pairs"]
    return pd.DataFrame(columns).rename_axis("L").reset_index()


def _budgets(data: pd.DataFrame) -> list[str]:
    spans = {m: (data[f"epochs_{m}"].min(), data[f"epochs_{m}"].max()) for m in ("D", "T")}
    return [
        "A trajectory of L steps has L (L + 1) / 2 pairs for T and L transitions for D.",
        f"The paper's epochs would be {spans['D'][0]} to {spans['D'][1]} gradient steps for D and",
        f"{spans['T'][0]} to {spans['T'][1]} for T; here every fit takes the same number.",
    ]


def _duels(errors: pd.DataFrame) -> pd.DataFrame:
    index, cells = ["length", "n_episodes", "seed"], ["length", "n_episodes"]
    longest = errors["length"].max()
    lines = []
    for trajectory, opponents in DUELS.items():
        mine = _pick(errors, trajectory, "none").set_index(index)["error"]
        for model, actions in opponents:
            theirs = _pick(errors, model, actions).set_index(index)["error"]
            ratio = theirs.groupby(cells).median() / mine.groupby(cells).median()
            always = (theirs > mine).groupby(cells).all()
            at_longest = ratio.xs(longest, level="length")
            line = {"trajectory model": trajectory, "against": _name(model, actions)}
            line |= {"better in": f"{(ratio > 1).sum()} of {len(ratio)}"}
            line |= {"in every seed": int(always.sum()), "median ratio": float(ratio.median())}
            line |= {f"better at L = {longest}": f"{(at_longest > 1).sum()} of {len(at_longest)}"}
            line |= {f"median ratio at L = {longest}": float(at_longest.median())}
            lines.append(line)
    return pd.DataFrame(lines)


def _best(errors: pd.DataFrame, shown: list[tuple[str, str]], baseline: float) -> pd.DataFrame:
    """Name of the best model by length (rows) and episodes (columns)."""
    grids = {key: _grid(errors, *key) for key in shown}
    first = next(iter(grids.values()))
    stack = np.stack([grid.to_numpy() for grid in grids.values()])
    names = np.array([model.replace(" (ours)", "") + _SHORT[how] for model, how in grids])
    best = names[stack.argmin(axis=0)].astype(object)
    useless = stack.min(axis=0) >= baseline
    best[useless] = [f"({name})" for name in best[useless]]
    table = pd.DataFrame(best, first.index, [f"N = {n}" for n in first.columns])
    return table.rename_axis("L").reset_index()


def _grid(errors: pd.DataFrame, model: str, actions: str) -> pd.DataFrame:
    """Median over seeds, length by episodes."""
    by = ["length", "n_episodes"]
    return _pick(errors, model, actions).groupby(by)["error"].median().unstack()


def _growth(errors: pd.DataFrame, by: str, symbol: str, baseline: float) -> pd.DataFrame:
    """Errors at every other size up to the greatest, and the least size that halves no change."""
    sizes = sorted(errors[by].unique())
    lines = []
    for model, actions in PAPER + OURS:
        some = _pick(errors, model, actions).groupby(by)["error"]
        line = {"model": _name(model, actions)}
        line |= {f"{symbol} = {size}": _entry(some.get_group(size)) for size in sizes[::-2][::-1]}
        enough = [size for size in sizes if some.get_group(size).median() < baseline / 2]
        line[f"least {symbol} for half of no change"] = str(enough[0]) if enough else "none"
        lines.append(line)
    return pd.DataFrame(lines)


def _extrapolation(errors: pd.DataFrame, still: pd.DataFrame) -> pd.DataFrame:
    shown = [PAPER[1], PAPER[-1], *OURS[1:]]
    tables = {_name(*key): _pick(errors, *key) for key in shown} | {"no change": still}
    lines = []
    for name, some in tables.items():
        for part in ("within", "beyond"):
            medians = some.groupby("length")[part].median()
            line = {"model": name, "horizons": part}
            lines.append(line | {f"L = {length}": v for length, v in medians.items()})
    return pd.DataFrame(lines)


def _first_step(errors: pd.DataFrame, still: pd.DataFrame) -> pd.DataFrame:
    longest = errors[errors["length"] == errors["length"].max()]
    # in the first step logged and recomputed actions are the same
    shown = [key for key in PAPER + OURS if key[1] != "logged" and _CLIPPED not in key[0]]
    values = {model: _pick(longest, model, how)["first"] for model, how in shown}
    values["no change"] = still.groupby("seed")["first"].first()
    lines = [{"model": name, "error": _entry(some)} for name, some in values.items()]
    return pd.DataFrame(lines)


# -- figures ----------------------------------------------------------------------------------


def draw(tables: Tables) -> dict[str, Any]:
    """The whole grid of every model, and two slices through it."""
    still = tables["no-change"].groupby("seed")["error"].first()
    return {
        "sample-efficiency": _heat_maps(tables["errors"], float(still.median())),
        "sample-efficiency-slices": _slices(tables["errors"], float(still.median())),
    }


def _heat_maps(errors: pd.DataFrame, baseline: float) -> Any:
    """The paper's settings on the left, ours on the right, the same colours in all."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    figure, axes = plt.subplots(
        len(PAPER), 2, figsize=(9, 13), layout="constrained", sharex=True, sharey=True
    )
    norm = LogNorm(_least(errors), max(_CEILING, 2 * baseline))
    for column, shown in zip(axes.T, (PAPER, OURS)):
        grids = [_grid(errors, *key) for key in shown]
        best = np.min([grid.to_numpy() for grid in grids], axis=0)
        for ax, key, grid in zip(column, shown, grids):
            image = _heat_map(ax, grid, norm, baseline=baseline, best=best)
            title = _name(*key)
            ax.set_title(title if "ours" in title else f"{title} (paper)", loc="left", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("N, training episodes")
    for ax in axes[:, 0]:
        ax.set_ylabel("L, steps")
    bar = figure.colorbar(image, ax=axes, location="bottom", aspect=50, extend="max", pad=0.02)
    bar.set_label(
        f"median over test episodes of the squared error, mean over {TEST_LENGTH} horizons "
        "(range = 1); line: nothing changes.\n"
        "Bold: better than that. Frame: best in its column of panels."
    )
    bar.ax.axvline(baseline, color="black", lw=2)
    return figure


def _least(errors: pd.DataFrame) -> float:
    return float(min(_grid(errors, *key).to_numpy().min() for key in PAPER + OURS))


def _heat_map(ax: Any, grid: pd.DataFrame, norm: Any, *, baseline: float, best: Floats) -> Any:
    from matplotlib.patches import Rectangle

    values = grid.to_numpy()
    # above the scale everything has one colour, infinite too
    shown = np.minimum(values, 2 * norm.vmax)
    image = ax.imshow(shown, norm=norm, cmap="cividis_r", aspect="auto", origin="lower")
    for (row, column), value in np.ndenumerate(values):
        dark = norm(min(value, norm.vmax)) > 0.55
        weight = "bold" if value < baseline else "normal"
        text = {"ha": "center", "va": "center", "fontsize": 8, "fontweight": weight}
        ax.text(column, row, _number(value), color="white" if dark else "black", **text)
        if value == best[row, column]:
            corner = (column - 0.45, row - 0.44)
            ax.add_patch(Rectangle(corner, 0.9, 0.88, fill=False, ec="#D55E00", lw=2))
    ax.set_xticks(range(len(grid.columns)), grid.columns)
    ax.set_yticks(range(len(grid.index)), grid.index)
    return image


def _number(value: float) -> str:
    """Two significant digits in little room."""
    if np.isinf(value):
        return "∞"
    if value < 1:
        return f"{value:.2g}".removeprefix("0")
    if value < 100:
        return f"{value:.2g}"
    return f"{value:.0e}".replace("e+0", "e").replace("e+", "e")


def _slices(errors: pd.DataFrame, baseline: float) -> Any:
    """By episodes of the greatest length, and by length with the most episodes."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(9.5, 8), layout="constrained", sharey=True)
    others = {"n_episodes": "length", "length": "n_episodes"}
    names = {"n_episodes": "N, training episodes", "length": "L, steps of a training episode"}
    for row, shown, title in zip(axes, (PAPER, OURS), ("paper's settings", "our defaults")):
        for ax, (by, fixed) in zip(row, others.items()):
            most = errors[fixed].max()
            for key in shown:
                some = _pick(errors[errors[fixed] == most], *key)
                _draw_slice(ax, over_seeds(some, [by], "error"), by, key)
            ax.axhline(baseline, color=GREY, lw=1.2, ls="dotted", label="nothing changes")
            what = f"L = {most} steps" if fixed == "length" else f"N = {most} episodes"
            ax.set_title(f"{title}, {what}", loc="left", fontsize=10)
            ax.set(xlabel=names[by], xticks=sorted(errors[by].unique()))
            tidy(ax)
        row[0].set_ylabel(f"error over {TEST_LENGTH} horizons (range = 1)")
    # what leaves at the top explodes or diverges
    axes[0, 0].set(yscale="log", ylim=(0.7 * _least(errors), 3))
    entries = [ax.get_legend_handles_labels() for ax in axes[:, 0]]
    by_label = {name: line for lines, names in entries for line, name in zip(lines, names)}
    below = {"loc": "outside lower center", "ncols": 3, "frameon": False, "handlelength": 4}
    figure.legend(by_label.values(), by_label, **below)
    return figure


def _style_name(model: str, actions: str) -> str:
    return _name(model.replace(" (ours)", ""), actions)


def _draw_slice(ax: Any, curve: pd.DataFrame, by: str, key: tuple[str, str]) -> None:
    """One line, in the same style in both rows."""
    name = _style_name(*key)
    i = list(dict.fromkeys(_style_name(*each) for each in PAPER + OURS)).index(name)
    style: dict[str, Any] = line_style(i)
    marks = {"marker": "os^DXvP"[i], "ms": 5, "mfc": "white"}
    low, middle, high = (curve[column].clip(upper=1e12) for column in ("low", "middle", "high"))
    ax.plot(curve[by], middle, lw=1.5, label=name, **marks, **style)
    ax.fill_between(curve[by], low, high, color=style["color"], alpha=0.13, lw=0)


BENCHMARK = Benchmark("sample-efficiency", __doc__, run, report, draw, settings, minutes=15)

if __name__ == "__main__":
    BENCHMARK.main()
