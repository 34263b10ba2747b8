"""Pictures of forecasts and their errors, with matplotlib (``pip install "trajlearn[plot]"``).

`plot_forecast` shows predicted against logged states, `plot_horizon_errors` how the error grows
with the horizon, `plot_reward_table` how well rewards are predicted,
`plot_selection` which formulation wins at which horizon, `plot_search` and `plot_slices` how a
policy search goes and what its model believes. Each draws into the axes it is given, or makes a
figure, and returns the axes, so that titles, limits and legends can be changed afterwards.
"""

from trajlearn.plotting.calibration import plot_coverage, plot_pit, plot_reliability
from trajlearn.plotting.errors import plot_horizon_errors
from trajlearn.plotting.fan import plot_fan
from trajlearn.plotting.forecasts import plot_forecast
from trajlearn.plotting.rewards import plot_reward_table
from trajlearn.plotting.search import plot_search, plot_slices
from trajlearn.plotting.selection import plot_selection

__all__ = [
    "plot_coverage",
    "plot_fan",
    "plot_forecast",
    "plot_horizon_errors",
    "plot_pit",
    "plot_reliability",
    "plot_reward_table",
    "plot_search",
    "plot_selection",
    "plot_slices",
]
