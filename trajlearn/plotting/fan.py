"""Fan charts: the uncertainty of one state of one episode."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._matching import with_states_of
from trajlearn.plotting._style import GREY, INK, axes_or_new, line_style, pyplot, tidy
from trajlearn.plotting.forecasts import _columns, _limit, _of_episode, _with_unit
from trajlearn.trajectories import TrajectoryDataset, as_dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_fan"]

Floats = NDArray[np.float64]


def plot_fan(
    forecast: Forecast,
    truth: TrajectoryDataset,
    episode: int = 0,
    state: str | None = None,
    ax: "Axes | None" = None,
    *,
    levels: Sequence[float] = (0.5, 0.9),
    units: Mapping[str, str] | None = None,
) -> "Axes":
    """Fan chart: one state of one episode, with intervals of several levels.

    Parameters
    ----------
    forecast : Forecast
        With std, samples or conformal bands.
    truth : TrajectoryDataset or list of Trajectory
        The episodes that were forecast, in the same order.
    episode : int, default=0
        Position of the episode; all forecasts of it are drawn.
    state : str, optional
        Default: the first that was forecast.
    ax : matplotlib Axes, optional
        Default: a new figure.
    levels : sequence of float, default=(0.5, 0.9)
        Probabilities inside the shaded intervals; the narrowest is darkest.
    units : mapping from name to unit, optional
        For the labels: of states, and of ``"time"``.

    Returns
    -------
    matplotlib Axes
        A vertical line marks where a forecast diverged.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If there is no such episode or state, or the forecast has no uncertainty.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import BayesianRidge
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(BayesianRidge(), random_state=0).fit(ds)
    >>> ax = plot_fan(model.predict(ds, return_std=True), ds, episode=3, units={"s0": "m"})
    >>> ax.get_ylabel()
    's0 (m)'
    """
    pyplot("plot_fan")
    ds, units = as_dataset(truth), dict(units or {})
    drawn = _of_episode(forecast, ds, episode)
    name = forecast.state_names[0] if state is None else state
    (column,) = _columns(forecast.state_names, [name])
    shared = with_states_of(forecast, ds)
    first, last = ds.offsets[episode : episode + 2]
    logged = None
    if name in shared.state_names:
        logged = shared.states[first:last, shared.state_names.index(name)]
    ax = axes_or_new(ax, "plot_fan", (6.4, 3.4))
    seen = drawn.mean[..., column] if logged is None else logged
    seen = seen[np.isfinite(seen)]
    for level, shade in zip(sorted(levels, reverse=True), _shades(len(levels))):
        with np.errstate(invalid="ignore"):
            lower, upper = (bound[..., column] for bound in drawn.interval(level))
        _band(ax, drawn, column, (lower, upper), seen, color=shade, label=f"{100 * level:g} %")
    for i, steps in enumerate(drawn.lengths):
        mean = np.append(drawn.initial_states[i, column], drawn.mean[i, :steps, column])
        mean[np.isinf(mean)] = np.nan
        times = np.append(drawn.initial_times[i], drawn.times[i, :steps])
        style = line_style(0) | {"linestyle": (0, (5, 1.5))}
        ax.plot(times, mean, lw=1.6, label="forecast" if i == 0 else None, **style)
        if drawn.diverged_at[i]:
            label = "diverged" if not any(drawn.diverged_at[:i]) else None
            ax.axvline(times[drawn.diverged_at[i]], color=GREY, lw=1, ls="dotted", label=label)
    if logged is not None:
        ax.plot(ds.times[first:last], logged, color=INK, lw=1.3, label="logged")
        _limit(ax, logged)
    ax.set_xlabel(_with_unit("time", units))
    ax.set_ylabel(_with_unit(name, units))
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 6}
    ax.legend(**place, frameon=False, fontsize="small", columnspacing=1.2)
    tidy(ax)
    return ax


def _shades(n: int) -> list[tuple[float, float, float]]:
    """Tints of one colour, light to dark."""
    from matplotlib.colors import to_rgb

    base = np.array(to_rgb(line_style(0)["color"]))
    strengths = np.linspace(0.18, 0.6, n) if n > 1 else np.array([0.35])
    return [tuple(1 - strength * (1 - base)) for strength in strengths]


def _band(
    ax: "Axes",
    drawn: Forecast,
    column: int,
    bounds: tuple[Floats, Floats],
    seen: Floats,
    **look: Any,
) -> None:
    """Interval of every forecast, from its initial state on."""
    # infinite bounds are to leave the picture, not to be left out of it
    room = 100 * (np.ptp(seen) or 1.0)
    for i, steps in enumerate(drawn.lengths):
        initial = drawn.initial_states[i, column]
        lower, upper = (
            np.append(initial, np.clip(bound[i, :steps], seen.min() - room, seen.max() + room))
            for bound in bounds
        )
        times = np.append(drawn.initial_times[i], drawn.times[i, :steps])
        ax.fill_between(times, lower, upper, lw=0, **look)
        look["label"] = None
