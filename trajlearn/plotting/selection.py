"""Which formulation wins at which horizon."""

from typing import TYPE_CHECKING, Any

import numpy as np
from sklearn.utils.validation import check_is_fitted

from trajlearn.plotting._style import GREY, INK, axes_or_new, line_style, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from trajlearn.dynamics.selector import HorizonSelector

__all__ = ["plot_selection"]

# weight from which on a line is broad
_BROAD = 0.1
# a block of the strip is named if it is at least this share of the width
_NAMED = 0.07


def plot_selection(
    selector: "HorizonSelector", ax: "Axes | None" = None, *, ceiling: float = 100.0
) -> "Axes":
    """Error by horizon of every member on held-out episodes, and beneath it who was chosen.

    Parameters
    ----------
    selector : HorizonSelector
        Fitted.
    ax : matplotlib Axes, optional
        Default: a new figure.
    ceiling : float, default=100.0
        Greatest squared error shown, unless all are greater; a diverged forecast lies above any.

    Returns
    -------
    matplotlib Axes
        Logarithmic in both; each line is the median over held-out episodes, broad where a member
        has weight. The strip beneath, ``ax.child_axes[0]``, shows the weights at each horizon.

    Raises
    ------
    ImportError
        If matplotlib is missing.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import HoldForecaster, HorizonSelector, MeanEpisodeForecaster
    >>> from trajlearn import TrajectoryDataset
    >>> from trajlearn.plotting import plot_selection
    >>> walks = np.cumsum(np.random.default_rng(0).normal(size=(20, 9, 1)), axis=1)
    >>> ds = TrajectoryDataset.from_arrays(walks, time_origin=np.zeros(20))
    >>> members = [("hold", HoldForecaster()), ("mean", MeanEpisodeForecaster())]
    >>> ax = plot_selection(HorizonSelector(members, random_state=0).fit(ds))
    >>> ax.get_yscale(), len(ax.child_axes)
    ('log', 1)
    """
    check_is_fitted(selector, "weights_")
    names, weights = selector.names_, selector.weights_
    table = selector.cv_errors_.pivot(index="horizon", columns="member", values="median")
    steps = table.index.to_numpy(dtype=np.float64)
    ax = axes_or_new(ax, "plot_selection", (6.4, 4.2 + 0.16 * len(names)))
    ax.set_xscale("log")
    ax.set_yscale("log", nonpositive="mask")
    least, greatest = np.inf, 0.0
    alone = "." if len(steps) == 1 else None
    for i, name in enumerate(names):
        style: dict[str, Any] = line_style(i)
        median = np.minimum(table[name].to_numpy(dtype=np.float64), 1e12)
        least = min(least, float(np.nanmin(median, initial=np.inf)))
        greatest = max(greatest, float(np.nanmax(median, initial=0.0)))
        used = weights[:, i] > _BROAD
        ax.plot(steps, median, lw=1.8 if used.any() else 1.0, label=name, marker=alone, **style)
        broad = np.where(used, median, np.nan)
        ax.plot(steps, broad, lw=7, alpha=0.3, color=style["color"], solid_capstyle="butt")
    if greatest > ceiling:
        ax.set_ylim(top=max(ceiling, 10 * least))
    ax.set_xlim(0.9, 1.04 * len(weights))
    ax.set_ylabel("squared error (training range = 1)\nmedian over held-out episodes")
    ax.tick_params(labelbottom=False)
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=4,
        frameon=False,
        fontsize="small",
        handlelength=3,
    )
    tidy(ax)
    _strip(ax, names, weights)
    return ax


def _strip(ax: "Axes", names: tuple[str, ...], weights: Any) -> None:
    """Weights as stacked areas under the x axis, the larger ones named."""
    strip = ax.inset_axes((0.0, -0.13, 1.0, 0.09))
    strip.set_xscale("log")
    strip.set_xlim(ax.get_xlim())
    strip.set_ylim(0, 1)
    # a step reaches half way to its neighbours
    edges = np.arange(len(weights) + 1) + 0.5
    edges[0] = strip.get_xlim()[0]
    edges[-1] = strip.get_xlim()[1]
    low = np.zeros(len(weights))
    for i, name in enumerate(names):
        high = low + weights[:, i]
        if not weights[:, i].any():
            continue
        strip.stairs(high, edges, baseline=low, fill=True, color=line_style(i)["color"], alpha=0.45)
        _name_blocks(strip, name, weights[:, i], (low + high) / 2, edges)
        low = high
    strip.set_yticks([])
    strip.set_xlabel("horizon (steps)")
    strip.text(-0.01, 0.5, "chosen", transform=strip.transAxes, ha="right", va="center", color=GREY)


def _name_blocks(strip: "Axes", name: str, weight: Any, middle: Any, edges: Any) -> None:
    """The name in each run of steps in which a member has most of the weight."""
    most = np.concatenate([[False], weight > 0.5, [False]])
    begins, ends = (
        np.flatnonzero(np.diff(most.astype(int)) == 1),
        np.flatnonzero(np.diff(most.astype(int)) == -1),
    )
    width = np.log(edges[-1] / edges[0])
    for a, b in zip(begins, ends):
        if np.log(edges[b] / edges[a]) < max(_NAMED, 0.014 * len(name)) * width:
            continue
        x = np.sqrt(edges[a] * edges[b])
        y = middle[a:b].mean()
        strip.text(x, y, name, ha="center", va="center", color=INK, fontsize="small")
