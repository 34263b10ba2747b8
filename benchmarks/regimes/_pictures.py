"""Figures: who wins where, errors by horizon, and how far the selector is from the best."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchmarks.paper._figures import draw_curve, horizon_axes, legend_below, over_seeds
from benchmarks.regimes._members import RULES
from benchmarks.regimes._page import judged_seeds, on_all_seeds
from benchmarks.regimes._regimes import POLICIES, REGIMES
from benchmarks.regimes._tables import BLOCKS, CURVE_MODELS, CURVES, EXACT, in_order
from trajlearn.plotting._style import GREY, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Columns of the map, by group, and how they are called.
COLUMNS = {
    "poly1": "linear",
    "poly3": "cubic",
    "network": "network",
    "gp": "GP",
    "poly1_em": "linear",
    "poly3_em": "cubic",
    "network_em": "network",
    "poly1_latent": "latent\nvelocities",
    "poly1_window": "5 past\nstates",
    "poly1_em_sees": "noisy\npolicy",
    "C": "closed\nloop C",
    "T": "trajec-\ntory T",
    "PySINDy": "PySINDy",
    "pykoop": "pykoop",
    "mbrl-lib": "mbrl-lib",
    "sklearn-GP": "sklearn\nGP",
    "pick": "selector",
}
_GROUPS = {"one-step": 4, "denoised": 3, "linear": 3, "with θ": 2, "peers": 4, "": 1}
#: Short names of models in cells.
_SHORT = {
    "poly1": "P1",
    "poly2": "P2",
    "poly3": "P3",
    "network": "net",
    "gp": "GP",
    "poly1_em": "P1, den.",
    "poly2_em": "P2, den.",
    "poly3_em": "P3, den.",
    "network_em": "net, den.",
    "poly1_latent": "P1, latent",
    "poly2_latent": "P2, latent",
    "poly3_latent": "P3, latent",
    "poly1_window": "P1, 5 states",
    "network_window": "net, 5 states",
    "poly1_em_sees": "P1, den., sees",
}
# ratios from which a cell is as dark as it gets
_DARKEST = 100.0
_NOT_RUN = "////"
_ERRORS = {
    "typical": "squared error, median over episodes, averaged over horizons",
    "cum": "squared error, averaged over episodes and horizons",
}


def who_wins(scores: dict[str, pd.DataFrame], error: str) -> "Figure":
    """Regimes by models: error over that of the best single model of the regime.

    Parameters
    ----------
    scores : dict of DataFrame
        Of each system.
    error : {"typical", "cum"}
        A column of them.
    """
    import matplotlib.pyplot as plt

    by_policy = {policy: _ratios(scores, policy, error) for policy in POLICIES}
    by_policy = {policy: table for policy, table in by_policy.items() if len(table)}
    n_rows = [len(table) for table in by_policy.values()]
    figure, axes = plt.subplots(
        len(by_policy),
        1,
        figsize=(10.5, 0.27 * sum(n_rows) + 1.5 * len(n_rows)),
        height_ratios=n_rows,
        layout="constrained",
        squeeze=False,
    )
    for ax, (policy, table) in zip(axes[:, 0], by_policy.items(), strict=True):
        _draw_map(ax, table)
        ax.set_title(f"policy {policy}", loc="left", fontsize=11, pad=18)
    figure.supxlabel(
        f"{_ERRORS[error]} / that of the best single model of the row (framed)\n"
        "on the same seeds, median over those a model was run on; hatched: not run",
        fontsize=9,
    )
    return figure


def _ratios(scores: dict[str, pd.DataFrame], policy: str, error: str) -> pd.DataFrame:
    """Error of each model (columns) over the least of a single one, by regime.

    A ratio is taken within a seed, so that models that were run on some seeds only have no better
    or worse ones.
    """
    tables = []
    for system, table in scores.items():
        some = table[(table["policy"] == policy) & table["seed"].isin(judged_seeds(table))]
        if some.empty:
            continue
        some = some.assign(ratio=some[error].clip(lower=EXACT))
        always = on_all_seeds(some[~some["model"].isin(RULES)])
        least = always.groupby(["regime", "seed"])["ratio"].min().rename("least")
        some = some.join(least, on=["regime", "seed"])
        some["ratio"] /= some["least"]
        cum = some.pivot_table("ratio", "regime", "model", aggfunc="median", sort=False)
        cum = cum.loc[in_order(system, cum.index)]
        single = cum.drop(columns=list(RULES), errors="ignore").min(axis=1)
        cum.index = [_row_label(system, name) for name in cum.index]
        tables.append(cum.div(single.to_numpy(), axis=0))
    if not tables:
        return pd.DataFrame()
    return pd.concat(tables).reindex(columns=list(COLUMNS))


def _row_label(system: str, regime: str) -> str:
    return regime if system in ("cartpole", "flights") else f"{system}: {regime}"


def _draw_map(ax: "Axes", table: pd.DataFrame) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    values = table.to_numpy(dtype=float)
    shades = np.clip(np.nan_to_num(values, nan=1.0, posinf=1e9), 1.0, _DARKEST)
    colours = plt.get_cmap("cividis_r")
    norm = LogNorm(1.0, _DARKEST)
    ax.imshow(np.ma.masked_invalid(np.where(np.isnan(values), np.nan, shades)), cmap=colours,
              norm=norm, aspect="auto")  # fmt: skip
    singles = [name not in RULES for name in table.columns]
    for i, row in enumerate(values):
        for j, value in enumerate(row):
            at = (j - 0.5, i - 0.5)
            if np.isnan(value):
                ax.add_patch(Rectangle(at, 1, 1, fill=False, hatch=_NOT_RUN, ec="0.7", lw=0))
                continue
            dark = norm(min(max(value, 1.0), _DARKEST)) > 0.55
            ax.text(j, i, _number(value), ha="center", va="center", fontsize=7.5,
                    color="white" if dark else "black")  # fmt: skip
            # a row whose best single model has no column has no frame
            if singles[j] and value == 1.0:
                inner = (j - 0.46, i - 0.44)
                ax.add_patch(Rectangle(inner, 0.92, 0.88, fill=False, ec="black", lw=1.6))
    ax.set_yticks(range(len(table)), table.index, fontsize=8)
    names = [COLUMNS[name] for name in table.columns]
    ax.set_xticks(range(len(names)), names, fontsize=7.5)
    ax.tick_params(length=0)
    edge = 0
    for group, width in _GROUPS.items():
        middle = edge + (width - 1) / 2
        if group:
            ax.text(middle, -0.62, group, ha="center", va="bottom", fontsize=8, color=GREY)
        edge += width
        ax.axvline(edge - 0.5, color="white", lw=3)
    for spine in ax.spines.values():
        spine.set_visible(False)


def _number(value: float) -> str:
    if not np.isfinite(value):
        return "∞"
    if value < 9.95:
        return f"{value:.1f}"
    if value < 999.5:
        return f"{value:.0f}"
    power = int(np.floor(np.log10(value)))
    return f"1e{power}"


def winners(scores: dict[str, pd.DataFrame]) -> "Figure":
    """Regimes by blocks of horizons: the best single model and its error."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    by_policy = {policy: _winners(scores, policy) for policy in POLICIES}
    labels = [
        _row_label(system, name)
        for (system, name) in REGIMES
        if any((system, name) in some for some in by_policy.values())
    ]
    figure, axes = plt.subplots(
        1, 2, figsize=(11, 0.3 * len(labels) + 1.3), layout="constrained", sharey=True
    )
    colours, norm = plt.get_cmap("cividis"), LogNorm(1e-8, 1e-2)
    keys = [key for key in REGIMES if _row_label(*key) in labels]
    for ax, (policy, found) in zip(axes, by_policy.items(), strict=True):
        for i, key in enumerate(keys):
            for j, block in enumerate(BLOCKS):
                at = (j - 0.5, i - 0.5)
                if key not in found:
                    ax.add_patch(Rectangle(at, 1, 1, fill=False, hatch=_NOT_RUN, ec="0.7", lw=0))
                    continue
                model, error = found[key][block]
                shade = norm(np.clip(error, 1e-8, 1e-2))
                ax.add_patch(Rectangle(at, 1, 1, fc=colours(shade), ec="white", lw=1))
                text = f"{_SHORT.get(model, model)}\n{error:.0e}"
                ax.text(j, i, text, ha="center", va="center", fontsize=6,
                        color="black" if shade > 0.5 else "white")  # fmt: skip
        ax.set_xlim(-0.5, len(BLOCKS) - 0.5)
        ax.set_ylim(len(keys) - 0.5, -0.5)
        ends = ["1 to 5", "6 to 25", "26 to 75", "76 to 150", "151 to 200"]
        ax.set_xticks(range(len(BLOCKS)), ends, fontsize=8)
        ax.set_title(f"policy {policy}", loc="left", fontsize=10)
        ax.set_xlabel("horizons (steps of 200; others in proportion)")
        ax.set_yticks(range(len(keys)), labels, fontsize=8)
        ax.tick_params(length=0)
        for spine in ax.spines.values():
            spine.set_visible(False)
    return figure


def _winners(
    scores: dict[str, pd.DataFrame], policy: str
) -> dict[tuple[str, str], dict[str, tuple[str, float]]]:
    """The best single model run on all seeds, and its median error, by regime and block."""
    found = {}
    for system, table in scores.items():
        some = table[(table["policy"] == policy) & table["seed"].isin(judged_seeds(table))]
        some = on_all_seeds(some[~some["model"].isin(RULES)])
        for regime, lines in some.groupby("regime", sort=False):
            over = lines.groupby("model")[BLOCKS].median()
            best = over.idxmin()
            found[system, str(regime)] = {b: (best[b], over.loc[best[b], b]) for b in BLOCKS}
    return found


def curves(system: str, table: pd.DataFrame) -> "Figure":
    """Median error by horizon of some regimes; the policy known where it can be."""
    import matplotlib.pyplot as plt

    regimes = [name for name in CURVES[system] if name in set(table["regime"])]
    n_columns = min(3, len(regimes))
    n_rows = -(-len(regimes) // n_columns)
    figure, grid = plt.subplots(
        n_rows,
        n_columns,
        figsize=(3.6 * n_columns + 1, 3.1 * n_rows + 0.9),
        layout="constrained",
        squeeze=False,
    )
    axes = grid.ravel()
    seeds = judged_seeds(table)
    for ax, regime in zip(axes, regimes):
        some = table[(table["regime"] == regime) & table["seed"].isin(seeds)]
        policy = "known" if "known" in set(some["policy"]) else "unknown"
        some = some[some["policy"] == policy]
        for i, model in enumerate(CURVE_MODELS[:-1]):
            curve = over_seeds(some[some["model"] == model], ["horizon"])
            if len(curve):
                draw_curve(ax, curve, i, _name(model), band=None)
        curve = over_seeds(some[some["model"] == "pick"], ["horizon"])
        ax.plot(curve["horizon"], curve["middle"], color="black", lw=4, alpha=0.3,
                label="selector", zorder=0)  # fmt: skip
        horizon_axes(ax, title=f"{regime}, policy {policy}")
        ax.set_ylabel("")
    for ax in axes[len(regimes) :]:
        ax.set_visible(False)
    for row in grid:
        row[0].set_ylabel("squared error\n(training range = 1)")
    legend_below(figure, axes[0], ncols=5, others=list(axes[1 : len(regimes)]))
    return figure


def _name(model: str) -> str:
    return {
        "network": "one-step network",
        "network_em": "the same, denoised",
        "poly3": "one-step polynomial",
        "poly3_em": "the same, denoised ",
        "poly1_latent": "linear, latent velocities",
    }.get(model, model)


def apart(system: str, ratios: pd.DataFrame) -> "Figure":
    """The selector's error over that of the best single model, over all horizons."""
    import matplotlib.pyplot as plt

    ratios = ratios[(ratios["rule"] == "pick") & ratios["seed"].isin(judged_seeds(ratios))]
    regimes = in_order(system, ratios["regime"])
    figure, axes = plt.subplots(
        1, 2, figsize=(9.5, 0.27 * len(regimes) + 1.4), layout="constrained", sharey=True
    )
    for ax, statistic in zip(axes, ("median", "mean"), strict=True):
        for k, policy in enumerate(POLICIES):
            some = ratios[(ratios["statistic"] == statistic) & (ratios["policy"] == policy)]
            for i, regime in enumerate(regimes):
                lines = some[some["regime"] == regime]
                if lines.empty:
                    continue
                _draw_spread(ax, lines, i + 0.18 * (2 * k - 1), filled=k == 0)
        for value in (1.0, 2.0, 4.0):
            ax.axvline(value, color=GREY, lw=1, ls="solid" if value == 1 else "dotted", zorder=0)
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        ax.set_xlim(min(low, 0.45), max(high, 5.0))
        shown = {0.5: "0.5", 1: "1", 2: "2", 4: "4"} if high < _DARKEST else {1: "1", 4: "4"}
        shown |= {10.0**k: f"1e{k}" for k in range(2, 12, 2) if 10.0**k < high}
        ax.set_xticks(list(shown), list(shown.values()))
        ax.minorticks_off()
        ax.set_title(f"{statistic} over episodes", loc="left", fontsize=10)
        ax.set_xlabel("error of the selector / of the best single model")
        tidy(ax)
    axes[0].set_yticks(range(len(regimes)), regimes, fontsize=8)
    axes[0].invert_yaxis()
    handles = [
        plt.Line2D([], [], color="black", marker="o", lw=1.2, ms=5, mfc=face, label=f"policy {p}")
        for p, face in zip(POLICIES, ("black", "white"), strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _draw_spread(ax: "Axes", lines: pd.DataFrame, y: float, *, filled: bool) -> None:
    """All horizons and seeds: extremes, middle half (median over seeds), median."""
    shown: dict[str, Any] = {"color": "black", "solid_capstyle": "butt"}
    ax.plot([lines["least"].min(), lines["worst"].max()], [y, y], lw=1, **shown)
    ax.plot([lines["q25"].median(), lines["q75"].median()], [y, y], lw=3.5, **shown)
    face = "black" if filled else "white"
    ax.plot(lines["middle"].median(), y, "o", ms=5, mec="black", mfc=face)
