"""Predicted against logged trajectories."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics import Forecast
from trajlearn.evaluation._matching import episode_of, with_states_of
from trajlearn.plotting._style import GREY, INK, line_style, pyplot, tidy
from trajlearn.trajectories import TrajectoryDataset, as_dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_forecast"]


def plot_forecast(
    forecast: Forecast,
    truth: TrajectoryDataset,
    episode: int = 0,
    states: Sequence[str] | None = None,
    axes: "Axes | Sequence[Axes] | None" = None,
    *,
    level: float = 0.9,
    units: Mapping[str, str] | None = None,
) -> "NDArray[Any]":
    """Forecast of one episode over its logged states, a panel a state.

    Parameters
    ----------
    forecast : Forecast
        With a standard deviation or samples, the central interval is shaded.
    truth : TrajectoryDataset or list of Trajectory
        The episodes that were forecast, in the same order.
    episode : int, default=0
        Position of the episode; all forecasts of it are drawn.
    states : sequence of str, optional
        Names of the states to draw. Default: all that were forecast.
    axes : matplotlib Axes or sequence of Axes, optional
        One a state. Default: a new figure with a shared time axis.
    level : float, default=0.9
        Probability inside the shaded interval.
    units : mapping from name to unit, optional
        For the labels: of states, and of ``"time"``.

    Returns
    -------
    ndarray of matplotlib Axes of shape (n_states,)
        A vertical line marks where a forecast diverged.

    Raises
    ------
    ImportError
        If matplotlib is missing.
    ValueError
        If there is no such episode or state, or the number of axes is wrong.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> slopes = np.linspace(1, 2, 9)[:, None]
    >>> ds = TrajectoryDataset.from_arrays(slopes[:, None] * np.linspace(0, 1, 7)[:, None])
    >>> model = TrajectoryRegressor(LinearRegression(), random_state=0).fit(ds)
    >>> axes = plot_forecast(model.predict(ds), ds, episode=3, units={"s0": "m"})
    >>> axes[0].get_ylabel()
    's0 (m)'
    """
    plt = pyplot("plot_forecast")
    ds, units = as_dataset(truth), dict(units or {})
    names = [states] if isinstance(states, str) else list(states or forecast.state_names)
    drawn = _of_episode(forecast, ds, episode)
    columns = _columns(forecast.state_names, names)
    shared = with_states_of(forecast, ds)
    measured = dict(zip(shared.state_names, shared.states.T))
    if axes is None:
        size = (6.4, 0.9 + 1.3 * len(names))
        figure, axes = plt.subplots(
            len(names), sharex=True, squeeze=False, figsize=size, layout="constrained"
        )
        figure.align_ylabels()
    panels = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(panels) != len(names):
        raise ValueError(f"{len(panels)} axes for {len(names)} states: give one a state.")
    first, last = ds.offsets[episode : episode + 2]
    for ax, name, column in zip(panels, names, columns):
        # an estimated velocity was not measured
        logged = measured[name][first:last] if name in measured else None
        if logged is not None:
            ax.plot(ds.times[first:last], logged, color=INK, lw=1.2, label="logged")
        _draw(ax, drawn, column, level)
        if logged is not None:
            _limit(ax, logged)
        ax.set_ylabel(_with_unit(name, units))
        tidy(ax)
    panels[-1].set_xlabel(_with_unit("time", units))
    panels[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=4, frameon=False)
    return panels


def _of_episode(forecast: Forecast, ds: TrajectoryDataset, episode: int) -> Forecast:
    if not 0 <= episode < len(ds):
        raise ValueError(f"episode = {episode} is none of the {len(ds)} episodes (0-based).")
    if forecast.episode is None and len(forecast) != len(ds):
        raise ValueError(f"{len(forecast)} forecasts, but {len(ds)} episodes.")
    rows = np.flatnonzero(episode_of(forecast) == episode)
    if not len(rows):
        raise ValueError(f"there is no forecast of episode {episode}.")
    return forecast[rows]


def _columns(known: Sequence[str], names: Sequence[str]) -> list[int]:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"states {unknown} were not forecast; choose from {list(known)}.")
    return [known.index(name) for name in names]


def _draw(ax: "Axes", forecast: Forecast, column: int, level: float) -> None:
    """Mean, interval and divergence of one state, for every start."""
    style = line_style(0) | {"linestyle": (0, (5, 1.5))}
    uncertain = forecast.std is not None or forecast.samples is not None
    bounds = forecast.interval(level) if uncertain else ()
    for i, steps in enumerate(forecast.lengths):
        label = "forecast" if i == 0 else None
        times = forecast.times[i, :steps]
        mean = np.append(forecast.initial_states[i, column], forecast.mean[i, :steps, column])
        ax.plot(np.append(forecast.initial_times[i], times), mean, lw=1.8, label=label, **style)
        if uncertain:
            lower, upper = (bound[i, :steps, column] for bound in bounds)
            label = f"{100 * level:g} % interval" if i == 0 else None
            ax.fill_between(times, lower, upper, color=style["color"], alpha=0.2, lw=0, label=label)
        if forecast.diverged_at[i]:
            label = "diverged" if not any(forecast.diverged_at[:i]) else None
            at = times[forecast.diverged_at[i] - 1]
            ax.axvline(at, color=GREY, lw=1, ls="dotted", label=label)


def _limit(ax: "Axes", logged: NDArray[np.float64]) -> None:
    """Keep the logged states readable where a forecast leaves them far behind."""
    low, high = logged.min(), logged.max()
    room = 1.5 * ((high - low) or 1.0)
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(bottom, low - room), min(top, high + room))


def _with_unit(name: str, units: Mapping[str, str]) -> str:
    return f"{name} ({units[name]})" if name in units else name
