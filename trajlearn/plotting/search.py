"""How a policy search goes, and what its model believes."""

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn.plotting._style import GREY, INK, axes_or_new, line_style, pyplot, tidy

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["plot_search", "plot_slices"]

Floats = NDArray[np.float64]
_CROSS: dict[str, Any] = {"marker": "X", "ms": 8}
_MEAN_PATH = "of the mean trajectory"


class _Assessed(Protocol):
    """What a model predicts for candidates."""

    reward: Floats
    expected: Floats | None
    std: Floats | None


class _Search(Protocol):
    """What is drawn: any of the searches of `trajlearn.control`."""

    @property
    def best_params_(self) -> Floats: ...

    @property
    def bounds(self) -> ArrayLike: ...

    def history(self) -> "pd.DataFrame": ...

    def predict_return(self, params: ArrayLike) -> _Assessed: ...


def plot_search(search: _Search, ax: "Axes | None" = None) -> "Axes":
    """Return of each trial, the best so far, and what was predicted of each.

    Parameters
    ----------
    search : PolicySearch, BayesianSearch or RandomSearch
        With at least one trial.
    ax : matplotlib Axes, optional
        Default: a new figure.

    Returns
    -------
    matplotlib Axes
        Grey: trials that were logged, not proposed. A cross marks a trial that ended early. A
        diamond is the expected return of a proposal, with one predicted standard deviation to
        each side; a dash, where it differs, the return of the mean trajectory, which the
        objective "mean" maximises.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If no trial was told yet.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import RandomSearch, Trajectory
    >>> search = RandomSearch(bounds=[[0, 1]], reward=lambda s: -s[..., 0], horizon=2)
    >>> for _ in range(3):
    ...     gain = search.ask()
    ...     search = search.tell(Trajectory(states=np.full((3, 1), gain[0]), params=gain))
    >>> ax = plot_search(search)
    >>> ax.get_xlabel()
    'trial'
    """
    pyplot("plot_search")
    from matplotlib.ticker import MaxNLocator

    history = search.history()
    if history.empty:
        raise ValueError("the search has no trial yet: tell() it one.")
    ax = axes_or_new(ax, "plot_search", (6.4, 3.4))
    number = history["trial"].to_numpy()
    returns = history["return"].to_numpy(dtype=np.float64)
    ended = history["terminated"].to_numpy(dtype=bool)
    logged = (history["source"] == "logged").to_numpy()
    ax.step(number, history["best"], where="post", color=INK, lw=1.3, label="best so far")
    for chosen, colour, label in (
        (logged, GREY, "logged"),
        (~logged, line_style(0)["color"], "trial"),
    ):
        looks = (chosen & ~ended, {"marker": "o"}, ""), (chosen & ended, _CROSS, ", ended early")
        for shown, look, more in looks:
            if shown.any():
                look = look | {"mfc": "white" if colour == GREY else colour}
                ax.plot(
                    number[shown], returns[shown], ls="", color=colour, label=label + more, **look
                )
    predicted = history["predicted"].to_numpy(dtype=np.float64)
    if np.isfinite(predicted).any():
        std = history["predicted_std"].to_numpy(dtype=np.float64)
        expected = history["expected"].to_numpy(dtype=np.float64)
        centre = np.where(np.isnan(expected), predicted, expected)
        # beside its trial, so that one does not hide the other
        aside = number + 0.12 + 0.004 * len(number)
        colour = line_style(1)["color"]
        ax.errorbar(
            aside,
            centre,
            std if np.isfinite(std).any() else None,
            fmt="D",
            ms=5,
            mfc="white",
            capsize=3,
            color=colour,
            label="predicted",
        )
        if (other := _differs(predicted, centre)).any():
            label = f"predicted, {_MEAN_PATH}"
            ax.plot(aside[other], predicted[other], "_", ms=11, mew=2, color=colour, label=label)
    ax.set_xlabel("trial")
    ax.set_ylabel("return")
    ax.set_xlim(number[0] - 0.5, number[-1] + 0.5)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, fontsize="small")
    tidy(ax)
    return ax


def plot_slices(
    search: _Search,
    params: ArrayLike | None = None,
    *,
    n_points: int = 41,
    axes: Any = None,
) -> NDArray[Any]:
    """Predicted return along each parameter, the others held: where the model is sure.

    Parameters
    ----------
    search : PolicySearch or BayesianSearch
        With a model and at least one trial.
    params : array-like of shape (p,), optional
        The point that the slices go through. Default: the best tried.
    n_points : int, default=41
        Points along each parameter, from bound to bound.
    axes : array-like of matplotlib Axes, optional
        One a parameter. Default: a new figure, four in a row.

    Returns
    -------
    ndarray of matplotlib Axes of shape (p,)
        Line: the expected return; shaded: one standard deviation to each side, where the model
        gives one. Dashed, where it differs: the return of the mean trajectory, which the
        objective "mean" maximises. The vertical line is `params`; ticks above the panel are the
        values tried so far, where they are within its range.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    TypeError
        If the search has no model, as a `RandomSearch`.
    ValueError
        If `params`, `n_points` or the number of axes is wrong.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import OneStepRegressor, PolicySearch, TrajectoryDataset
    >>> states = np.cumprod(np.repeat([[1.0], [0.5], [0.8]], 6, axis=1), axis=1)[..., None]
    >>> ds = TrajectoryDataset.from_arrays(states, params=[[0.0], [0.5], [0.2]])
    >>> model = OneStepRegressor(LinearRegression(), inputs="params")
    >>> search = PolicySearch(
    ...     model, bounds=[[0, 1]], reward=lambda s: -np.abs(s[..., 0]), horizon=5, random_state=0
    ... ).tell(ds)
    >>> (ax,) = plot_slices(search, n_points=5)
    >>> ax.get_xlabel()
    'theta0'
    """
    plt = pyplot("plot_slices")
    if not hasattr(search, "predict_return"):
        raise TypeError(
            f"{type(search).__name__} has no model that predicts returns: use plot_search, or tell "
            "the trials to a PolicySearch or a BayesianSearch."
        )
    if n_points < 2:
        raise ValueError(f"n_points = {n_points} must be at least 2.")
    bounds = np.asarray(search.bounds, dtype=np.float64)
    n_params = len(bounds)
    through = np.asarray(search.best_params_ if params is None else params, dtype=np.float64)
    if through.shape != (n_params,):
        raise ValueError(f"params has shape {through.shape}; expected ({n_params},).")
    if not np.isfinite(through).all():
        raise ValueError("params has NaN or infinite values.")
    history = search.history()
    names = list(history.columns[1 : 1 + n_params])
    first_of_row, own_figure = slice(0, 1), axes is None
    if axes is None:
        across = min(n_params, 4)
        down = -(-n_params // across)
        _, axes = plt.subplots(
            down,
            across,
            sharey=True,
            squeeze=False,
            figsize=(1.2 + 2.3 * across, 0.6 + 2.3 * down),
            layout="constrained",
        )
        for ax in axes.ravel()[n_params:]:
            ax.remove()
        axes, first_of_row = axes.ravel()[:n_params], slice(None, None, across)
    panels = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(panels) != n_params:
        raise ValueError(f"{len(panels)} axes for {n_params} parameters: give one a parameter.")
    lines = np.tile(through, (n_params, n_points, 1))
    for i, (low, high) in enumerate(bounds):
        lines[i, :, i] = np.linspace(low, high, n_points)
    assessed = search.predict_return(lines.reshape(-1, n_params))
    of_mean_path = assessed.reward.reshape(n_params, n_points)
    expected = assessed.reward if assessed.expected is None else assessed.expected
    means = expected.reshape(n_params, n_points)
    two_lines = _differs(of_mean_path, means).any()
    colour = line_style(0)["color"]
    for i, (ax, name) in enumerate(zip(panels, names)):
        x = lines[i, :, i]
        if assessed.std is not None:
            std = assessed.std.reshape(n_params, n_points)[i]
            ax.fill_between(x, means[i] - std, means[i] + std, color=colour, alpha=0.25, lw=0)
        ax.plot(x, means[i], color=colour, lw=1.6, label="expected")
        if two_lines:
            ax.plot(x, of_mean_path[i], color=INK, lw=1.3, ls="dashed", label=_MEAN_PATH)
        ax.axvline(through[i], color=INK, lw=1, ls="dotted")
        ends = [min(x[0], through[i]), max(x[-1], through[i])]
        margin = 0.04 * (ends[1] - ends[0])
        ax.set_xlim(ends[0] - margin, ends[1] + margin)
        tried = history[name].to_numpy(dtype=np.float64)
        tried = tried[(tried >= ends[0]) & (tried <= ends[1])]
        # above the panel, where no curve is
        top = ax.get_xaxis_transform()
        ax.plot(
            tried, np.full(len(tried), 1.03), "|", color=GREY, ms=8, transform=top, clip_on=False
        )
        ax.set_xlabel(name)
        tidy(ax)
    for ax in panels[first_of_row]:
        ax.set_ylabel("predicted return")
    if two_lines:
        looks: dict[str, Any] = {"ncols": 2, "frameon": False, "fontsize": "small"}
        if own_figure:
            lines_of = panels[0].get_legend_handles_labels()
            panels[0].figure.legend(*lines_of, loc="outside upper left", **looks)
        else:
            panels[0].legend(loc="lower left", bbox_to_anchor=(0, 1.03), **looks)
    return panels


def _differs(a: Floats, b: Floats) -> NDArray[np.bool_]:
    """Where two predictions of a return are not the same, by more than rounding."""
    return ~np.isclose(a, b, rtol=1e-6, equal_nan=True)
