import sys

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from trajlearn import (
    KalmanSmoother,
    MLPEnsembleRegressor,
    TrajectoryDataset,
    TrajectoryRegressor,
)
from trajlearn.evaluation import (
    cross_validate_horizons,
    horizon_errors,
    reward_errors,
    summarise,
)
from trajlearn.plotting import plot_forecast, plot_horizon_errors, plot_reward_table

plt = pytest.importorskip("matplotlib.pyplot")
INF, NAN = np.inf, np.nan


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()  # whatever cannot be drawn fails here
    plt.close("all")


@pytest.fixture(scope="module")
def decays():
    rate = np.linspace(0.5, 1.5, 6)[:, None]
    states = np.exp(-rate * 0.1 * np.arange(21))[..., None] * [1.0, -3.0]
    return TrajectoryDataset.from_arrays(states, params=rate, dt=0.1, state_names=["x", "y"])


@pytest.fixture(scope="module")
def model(decays):
    net = MLPEnsembleRegressor(hidden_layer_sizes=(8,), max_steps=20, probabilistic=True)
    return TrajectoryRegressor(net, random_state=0).fit(decays)


def curves(ax):
    """Data by label, unlabelled lines left out."""
    lines = [line for line in ax.get_lines() if not line.get_label().startswith("_")]
    return {line.get_label(): line.get_xydata() for line in lines}


# -- plot_horizon_errors ------------------------------------------------------------------


def errors_table(*rows):
    columns = pd.Index(range(1, len(rows[0]) + 1), name="horizon")
    return pd.DataFrame(np.array(rows, dtype=float), columns=columns)


def test_curves_are_medians_and_bands_reach_the_percentiles():
    table = errors_table([0.1, 0.2], [0.2, 0.4], [0.3, 1.0])
    ax = plot_horizon_errors({"T": table})
    assert ax.get_yscale() == "log"
    assert_allclose(curves(ax)["T"], [[1, 0.2], [2, 0.4]])
    tops = [band.get_paths()[0].vertices[:, 1].max() for band in ax.collections]
    assert_allclose(tops, summarise(table).loc[2, ["q65", "q95"]])
    assert not plot_horizon_errors({"T": table}, band=()).collections


def test_every_kind_of_table_gives_the_same_curve(decays, model):
    cv = [(np.arange(6), np.arange(6))] * 2
    folds = cross_validate_horizons(
        TrajectoryRegressor(LinearRegression(), random_state=0), decays, range(1, 21), cv=cv
    )
    fitted = TrajectoryRegressor(LinearRegression(), random_state=0).fit(decays)
    errors = horizon_errors(fitted.predict(decays), decays)
    ax = plot_horizon_errors({"errors": errors, "summary": summarise(errors), "folds": folds})
    first, *others = curves(ax).values()
    for other in others:
        assert_allclose(other, first)
    with pytest.raises(ValueError, match=r"tables\['odd'\] has the columns \['a'\]"):
        plot_horizon_errors({"odd": pd.DataFrame({"a": [1.0]})})
    with pytest.raises(ValueError, match="empty"):
        plot_horizon_errors({})


def test_a_diverged_median_leaves_at_the_top_and_is_counted():
    exploding = errors_table([0.1, 0.2, INF], [0.1, 0.2, INF], [0.1, 0.2, 0.3])
    ax = plot_horizon_errors({"D": exploding, "T": errors_table([0.1, 0.1, 0.1])}, ceiling=10.0)
    assert set(curves(ax)) == {"D (2 of 3 diverge)", "T"}
    assert ax.get_ylim()[1] == 10
    (triangle,) = [line for line in ax.get_lines() if line.get_marker() == "^"]
    assert_allclose(triangle.get_xydata(), [[3, 1.0]])
    finite = plot_horizon_errors({"T": errors_table([0.1, 0.1, 0.1])}, ceiling=10.0)
    assert finite.get_ylim()[1] < 10
    assert all(line.get_marker() != "^" for line in finite.get_lines())


def test_curves_differ_in_their_dashes_and_the_training_length_is_marked():
    tables = {name: errors_table([0.1, 0.2]) for name in "abcde"}
    _, given = plt.subplots()
    ax = plot_horizon_errors(tables, given, training_length=1.5)
    assert ax is given
    dashes = {str(line._dash_pattern) for line in ax.get_lines()[:5]}
    assert len(dashes) == 5
    assert_allclose(curves(ax)["longest horizon in training"][:, 0], 1.5)


def test_horizons_that_nobody_reaches_and_a_single_horizon_are_drawn():
    ax = plot_horizon_errors({"gap": errors_table([0.1, NAN, 0.2]), "one": errors_table([0.1])})
    assert np.isnan(curves(ax)["gap"][1, 1])
    assert ax.get_lines()[1].get_marker() == "o"


# -- plot_forecast ------------------------------------------------------------------------


def test_forecast_and_log_share_a_panel_a_state(decays, model):
    forecast = model.predict(decays)
    axes = plot_forecast(forecast, decays, episode=2, units={"x": "m", "time": "s"})
    assert [ax.get_ylabel() for ax in axes] == ["x (m)", "y"]
    assert axes[-1].get_xlabel() == "time (s)"
    assert axes[0].get_shared_x_axes().joined(*axes)
    for j, ax in enumerate(axes):
        drawn = curves(ax)
        assert_allclose(drawn["logged"][:, 1], decays[2].states[:, j])
        assert_allclose(drawn["forecast"][0], [0, decays[2].states[0, j]])
        assert_allclose(drawn["forecast"][1:, 1], forecast.mean[2, :, j])
        assert_allclose(drawn["forecast"][1:, 0], decays[2].times[1:])
        assert not ax.collections


@pytest.mark.parametrize("asked", [{"return_std": True}, {"n_samples": 50, "random_state": 0}])
def test_uncertainty_is_shaded_by_level(decays, model, asked):
    forecast = model.predict(decays, **asked)
    heights = []
    for level in (0.5, 0.9):
        (ax,) = plot_forecast(forecast, decays, states=["y"], level=level)
        (band,) = ax.collections
        box = band.get_paths()[0].get_extents()
        lower, upper = forecast.interval(level)
        assert_allclose([box.y0, box.y1], [lower[0, :, 1].min(), upper[0, :, 1].max()])
        heights.append(box.height)
        assert f"{100 * level:g} % interval" in ax.get_legend_handles_labels()[1]
    assert heights[0] < heights[1]


def test_a_later_start_several_starts_and_ragged_episodes(decays, model):
    short = TrajectoryDataset([decays[0], *decays.truncate(7)], state_names=["x", "y"])
    forecast = model.predict(short, start=5)
    drawn = curves(plot_forecast(forecast, short, episode=1)[0])
    assert_allclose(drawn["forecast"][:, 0], short[1].times[5:])
    assert_allclose(drawn["logged"][:, 0], short[1].times)
    several = model.predict(decays, start=[[0, 10]] * 6, horizon=4)
    lines = plot_forecast(several, decays, episode=3)[0].get_lines()
    assert [len(line.get_xdata()) for line in lines] == [21, 5, 5]


def test_divergence_is_marked_and_does_not_spoil_the_scale(decays, model):
    forecast = model.predict(decays)
    forecast.mean[0, 5:, 0] = 1e9
    forecast.mean[0, 7:] = INF
    forecast.diverged_at[0] = 8
    ax = plot_forecast(forecast, decays)[0]
    assert_allclose(curves(ax)["diverged"][:, 0], decays[0].times[8])
    assert np.ptp(ax.get_ylim()) < 10


def test_states_of_a_selected_forecast_are_found_by_name(decays):
    only_y = decays.select_states(["y"])
    forecast = TrajectoryRegressor(LinearRegression()).fit(only_y).predict(only_y)
    _, given = plt.subplots()
    (ax,) = plot_forecast(forecast, decays, axes=given)
    assert ax is given
    assert_allclose(curves(ax)["logged"][:, 1], decays[0].states[:, 1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episode": 6}, "episode = 6 is none of the 6 episodes"),
        ({"episode": -1}, "episode = -1"),
        ({"states": ["z"]}, r"\['z'\] were not forecast"),
        ({"axes": [None]}, "1 axes for 2 states"),
    ],
)
def test_what_cannot_be_drawn_is_refused(decays, model, arguments, message):
    with pytest.raises(ValueError, match=message):
        plot_forecast(model.predict(decays), decays, **arguments)


def test_forecasts_of_other_episodes_are_refused(decays, model):
    with pytest.raises(ValueError, match="6 forecasts, but 2 episodes"):
        plot_forecast(model.predict(decays), decays[:2])
    several = model.predict(decays[:2], start=[[0, 3]] * 2)
    with pytest.raises(ValueError, match="no forecast of episode 4"):
        plot_forecast(several, decays, episode=4)


# -- plot_reward_table --------------------------------------------------------------------


def reward_table(**rows):
    return pd.DataFrame.from_dict(rows, orient="index")


def test_bars_end_at_the_mean_with_median_and_paper_marked():
    table = reward_table(
        T=reward_errors([1.0, 2.0, 3.0], [1.1, 2.2, 3.5]) | {"paper": 0.01},
        C=reward_errors([1.0, 2.0, 3.0], [2.0, 2.2, 3.1]) | {"paper": NAN},
    )
    ax = plot_reward_table(table)
    assert ax.get_xscale() == "log"
    assert ax.yaxis_inverted()
    assert [label.get_text() for label in ax.get_yticklabels()] == ["T", "C"]
    ends = [bar.get_x() + bar.get_width() for bar in ax.patches]
    assert_allclose(ends, table["mean"])
    marks = {item.get_label(): item.get_offsets() for item in ax.collections}
    assert_allclose(marks["median"][:, 0], table["median"])
    assert_allclose(marks["mean, paper"][0], [0.01, 0])
    assert [text.get_text() for text in ax.texts] == [f"{mean:.2g}" for mean in table["mean"]]


def test_a_method_that_diverges_is_hatched_and_does_not_squeeze_the_others():
    table = reward_table(
        T=reward_errors([1.0, 2.0], [1.1, 2.2]),
        D=reward_errors([-INF, 1e9], [1.0, 2.0]),
        P=reward_errors([1e6, 0.0], [1.0, 0.0]),
    )
    ax = plot_reward_table(table)
    assert ax.get_xlim()[1] == 100
    assert [bool(bar.get_hatch()) for bar in ax.patches] == [False, True, True]
    assert [text.get_text() for text in ax.texts] == ["0.025", "1 of 2 diverge", "5e+11"]
    assert plot_reward_table(table, ceiling=10.0).get_xlim()[1] == 10


def test_reward_table_needs_its_columns_and_a_number():
    with pytest.raises(ValueError, match="at least mean and median"):
        plot_reward_table(reward_table(T={"mean": 1.0}))
    with pytest.raises(ValueError, match="no positive finite"):
        plot_reward_table(reward_table(T={"mean": INF, "median": 0.0}))
    _, given = plt.subplots()
    assert plot_reward_table(reward_table(T={"mean": 1e3, "median": 5e2}), given) is given


# -- without matplotlib -------------------------------------------------------------------


@pytest.mark.parametrize("function", [plot_forecast, plot_horizon_errors, plot_reward_table])
def test_a_missing_matplotlib_says_what_to_install(decays, model, monkeypatch, function):
    arguments = {
        plot_forecast: (model.predict(decays), decays),
        plot_horizon_errors: ({"T": errors_table([0.1])},),
        plot_reward_table: (reward_table(T={"mean": 1.0, "median": 1.0}),),
    }[function]
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=rf"{function.__name__} needs .*trajlearn\[plot\]"):
        function(*arguments)


def test_a_state_that_was_estimated_has_a_forecast_and_no_log():
    """A smoother appends a velocity: it is drawn, and the position beside it is the logged one."""
    rng = np.random.default_rng(0)
    track = np.cumsum(np.cumsum(rng.normal(size=(6, 30, 1)), axis=1), axis=1)
    ds = TrajectoryDataset.from_arrays(track + rng.normal(size=track.shape), state_names=["x"])
    model = make_pipeline(
        KalmanSmoother(append_velocities=True), TrajectoryRegressor(LinearRegression())
    )
    axes = plot_forecast(model.fit(ds).predict(ds, start=5), ds, episode=2)
    assert [len(ax.lines) for ax in axes] == [2, 1]
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata(), ds[2].states[:, 0])
