import sys

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline

from tests.evaluation.gaussian_forecasts import around, walks
from trajlearn import KalmanSmoother, TrajectoryDataset, TrajectoryRegressor
from trajlearn.evaluation.calibration import calibration_report, pit_histogram, reliability
from trajlearn.plotting.calibration import plot_coverage, plot_pit, plot_reliability
from trajlearn.plotting.fan import plot_fan

plt = pytest.importorskip("matplotlib.pyplot")
INF, NAN = np.inf, np.nan
FEW = {"n_bootstrap": 20, "random_state": 0}
REPORT = FEW | {"levels": (0.5, 0.9, 0.95)}


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()  # whatever cannot be drawn fails here
    plt.close("all")


@pytest.fixture(scope="module")
def flights():
    return walks(np.random.default_rng(0), [30, 12, 28, 30])


@pytest.fixture(scope="module")
def forecast(flights):
    return around(flights, np.random.default_rng(1), n_samples=20)


@pytest.fixture(scope="module")
def diverging(flights):
    forecast = around(flights, np.random.default_rng(2))
    forecast.mean[2, 7:28] = forecast.std[2, 7:28] = INF
    forecast.diverged_at[2] = 8
    return forecast


def curves(ax):
    lines = [line for line in ax.get_lines() if not line.get_label().startswith("_")]
    return {line.get_label(): line.get_xydata() for line in lines}


def rows(table, state="all", **keys):
    chosen = table[table["state"] == state]
    for name, value in keys.items():
        chosen = chosen[chosen[name] == value]
    return chosen


# -- plot_coverage ------------------------------------------------------------------------


def test_coverage_of_bins_beside_the_promise(flights, forecast, diverging):
    reports = {
        "good": calibration_report(forecast, flights, **REPORT),
        "bad": calibration_report(diverging, flights, **REPORT),
    }
    axes = plot_coverage(reports, state="y")
    assert [ax.get_title() for ax in axes] == [f"{p} % intervals" for p in (50, 90, 95)]
    for ax, level in zip(axes, (0.5, 0.9, 0.95)):
        drawn = curves(ax)
        assert set(drawn) == {"promised", "good", "bad (1 of 4 diverge)"}
        assert_allclose(drawn["promised"][:, 1], level)
        expected = rows(reports["good"], "y", measure="coverage", level=level)
        assert_allclose(drawn["good"][:, 1], expected["value"])
        bars = ax.collections[0].get_segments()
        assert_allclose([bar[:, 1] for bar in bars], expected[["low", "high"]])
        assert [text.get_text() for text in ax.get_xticklabels()] == ["1-5", "6-25", "26-30"]
        # side by side
        x = [line[:, 0] for label, line in drawn.items() if label != "promised"]
        assert_allclose(np.mean(x, axis=0), [0, 1, 2])
        assert (x[0] != x[1]).all()
        assert ax.get_xlabel() == "horizon (steps)"
    assert axes[0].get_ylabel() == "coverage of y"
    assert len(axes[0].figure.legends) == 1


def test_coverage_of_every_horizon_is_a_shaded_curve(flights, forecast):
    report = calibration_report(forecast, flights, bins=None, **REPORT)
    (ax,) = plot_coverage(report, levels=[0.5])
    expected = rows(report, measure="coverage", level=0.5)
    assert_allclose(curves(ax)["forecast"], expected[["first", "value"]])
    (band,) = ax.collections
    corners = band.get_paths()[0].vertices
    for h, low, high in expected[["first", "low", "high"]].to_numpy():
        y = corners[corners[:, 0] == h, 1]
        assert_allclose([y.min(), y.max()], [low, high])


def test_axes_can_be_given(flights, forecast):
    report = calibration_report(forecast, flights, **REPORT)
    _, given = plt.subplots(1, 3)
    assert list(plot_coverage(report, given)) == list(given)
    assert given[0].get_legend() is not None
    assert not given[0].figure.legends
    with pytest.raises(ValueError, match="2 axes for 3 panels: give one a level"):
        plot_coverage(report, given[:2])


def test_the_shared_levels_are_drawn(flights, forecast):
    reports = {
        "a": calibration_report(forecast, flights, **REPORT | {"levels": [0.5, 0.9]}),
        "b": calibration_report(forecast, flights, **REPORT | {"levels": [0.9, 0.99]}),
    }
    assert [ax.get_title() for ax in plot_coverage(reports)] == ["90 % intervals"]
    with pytest.raises(ValueError, match=r"levels = \[0.5\] are not in every report"):
        plot_coverage(reports, levels=[0.5])


# -- plot_reliability and plot_pit --------------------------------------------------------


def test_reliability_goes_along_the_diagonal_a_panel_a_bin(flights, forecast, diverging):
    tables = {name: reliability(f, flights, **FEW) for name, f in (("a", forecast),)}
    axes = plot_reliability(tables)
    assert [ax.get_title() for ax in axes] == ["steps 1-5", "steps 6-25", "steps 26-30"]
    for ax, first in zip(axes, (1, 6, 26)):
        expected = rows(tables["a"], first=first)
        assert_allclose(curves(ax)["a"], expected[["level", "value"]])
        assert_allclose(curves(ax)["ideal"], [[0, 0], [1, 1]])
        assert len(ax.collections) == 1
    # a report has some of the levels
    report = calibration_report(forecast, flights, **REPORT | {"levels": [0.9, 0.2]})
    assert_allclose(curves(plot_reliability(report)[0])["forecast"][:, 0], [0.2, 0.9])
    with pytest.raises(ValueError, match="30 panels, one a bin, cannot be read"):
        plot_reliability(reliability(forecast, flights, bins=None, **FEW))


def test_pit_bars_have_the_heights_of_the_table(flights, forecast, diverging):
    table = pit_histogram(forecast, flights, n_bins=5, **FEW)
    axes = plot_pit(table, state="x")
    for ax, first in zip(axes, (1, 6, 26)):
        expected = rows(table, "x", first=first)
        outline, filled = ax.patches
        for patch in (outline, filled):
            assert_allclose(patch.get_data().values, expected["value"])
            assert_allclose(patch.get_data().edges, np.arange(6) / 5)
        bars = ax.collections[0].get_segments()
        assert_allclose([bar[:, 1] for bar in bars], expected[["low", "high"]])
        assert ax.get_ylim()[0] == 0
    both = {"a": table, "b": pit_histogram(diverging, flights, n_bins=4, **FEW)}
    assert all(len(ax.patches) == 2 for ax in plot_pit(both))
    assert axes[0].get_ylabel() == "density, x"


def test_tables_of_another_kind_are_refused(flights, forecast):
    report = calibration_report(forecast, flights, **REPORT)
    histogram = pit_histogram(forecast, flights, **FEW)
    for plot, table in (
        (plot_coverage, histogram),
        (plot_reliability, histogram),
        (plot_pit, report),
        (plot_coverage, pd.DataFrame({"a": [1.0]})),
    ):
        with pytest.raises(ValueError, match="give one from"):
            plot({"odd": table})
        with pytest.raises(ValueError, match="no table to draw"):
            plot({})
    for plot, table in ((plot_coverage, report), (plot_pit, histogram)):
        with pytest.raises(ValueError, match=r"no state 'q'; choose from \['all', 'x', 'y'\]"):
            plot(table, state="q")


# -- plot_fan -----------------------------------------------------------------------------


def test_a_fan_opens_from_the_initial_state(flights, forecast):
    ax = plot_fan(forecast, flights, 2, "y", units={"y": "m", "time": "s"})
    drawn = curves(ax)
    assert_allclose(drawn["logged"][:, 1], flights[2].states[:, 1])
    assert_allclose(drawn["forecast"][0], [0, flights[2].states[0, 1]])
    assert_allclose(drawn["forecast"][1:, 1], forecast.mean[2, :28, 1])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "y (m)")
    labels = [band.get_label() for band in ax.collections]
    assert labels == ["90 %", "50 %"]
    shades = [band.get_facecolor()[0, :3].mean() for band in ax.collections]
    assert shades == sorted(shades, reverse=True)
    for band, level in zip(ax.collections, (0.9, 0.5)):
        initial = flights[2].states[0, 1]
        lower, upper = (np.append(initial, b[2, :28, 1]) for b in forecast.interval(level))
        box = band.get_paths()[0].get_extents()
        assert_allclose([box.y0, box.y1], [lower.min(), upper.max()])
        assert box.x0 == 0


def test_defaults_several_starts_and_given_axes(flights):
    forecast = around(flights, np.random.default_rng(0), starts=[[0, 6]] * 4)
    _, given = plt.subplots()
    ax = plot_fan(forecast, flights, 1, ax=given, levels=[0.8])
    assert ax is given
    assert ax.get_ylabel() == "x"
    starts = [line.get_xdata()[0] for line in ax.get_lines()[:2]]
    assert starts == [0, 6]
    assert ax.collections[0].get_label() == "80 %"
    assert len(ax.collections) == 2
    assert len(ax.get_legend().get_texts()) == 3


def test_divergence_is_marked_and_infinite_intervals_fill_the_picture(flights, diverging):
    ax = plot_fan(diverging, flights, 2)
    assert_allclose(curves(ax)["diverged"][:, 0], flights[2].times[8])
    assert np.isfinite(curves(ax)["forecast"]).all(axis=1).sum() == 8
    wide = around(flights, np.random.default_rng(0))
    wide.std[0, 10:] = INF
    ax = plot_fan(wide, flights, 0)
    low, high = ax.get_ylim()
    box = ax.collections[0].get_paths()[0].get_extents()
    assert box.y0 < low
    assert box.y1 > high
    assert high - low < 5 * np.ptp(flights[0].states[:, 0])


def test_a_state_that_was_estimated_has_a_fan_and_no_log():
    rng = np.random.default_rng(0)
    track = np.cumsum(np.cumsum(rng.normal(size=(6, 30, 1)), axis=1), axis=1)
    ds = TrajectoryDataset.from_arrays(track + rng.normal(size=track.shape), state_names=["x"])
    model = make_pipeline(
        KalmanSmoother(append_velocities=True), TrajectoryRegressor(LinearRegression())
    )
    forecast = model.fit(ds).predict(ds, start=5)
    forecast.std = np.ones_like(forecast.mean)
    assert set(curves(plot_fan(forecast, ds, 2, "d_x"))) == {"forecast"}
    assert set(curves(plot_fan(forecast, ds, 2, "x"))) == {"forecast", "logged"}


def test_what_has_no_fan_is_refused(flights, forecast):
    with pytest.raises(ValueError, match="no uncertainty"):
        plot_fan(forecast._replace(std=None, samples=None), flights)
    with pytest.raises(ValueError, match=r"\['q'\] were not forecast"):
        plot_fan(forecast, flights, state="q")
    with pytest.raises(ValueError, match="episode = 4 is none of the 4"):
        plot_fan(forecast, flights, 4)


def test_a_missing_matplotlib_says_what_to_install(flights, forecast, monkeypatch):
    report = calibration_report(forecast, flights, **REPORT)
    histogram = pit_histogram(forecast, flights, **FEW)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    for plot, arguments in (
        (plot_coverage, (report,)),
        (plot_reliability, (report,)),
        (plot_pit, (histogram,)),
        (plot_fan, (forecast, flights)),
    ):
        with pytest.raises(ImportError, match=rf"{plot.__name__} needs .*trajlearn\[plot\]"):
            plot(*arguments)
