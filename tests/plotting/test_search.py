import sys
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from trajlearn import BayesianSearch, PolicySearch, RandomSearch, Trajectory
from trajlearn.plotting import plot_search, plot_slices

plt = pytest.importorskip("matplotlib.pyplot")
NAN = np.nan


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()  # whatever cannot be drawn fails here
    plt.close("all")


@dataclass
class Assessed:
    reward: np.ndarray
    std: np.ndarray | None
    expected: np.ndarray | None = None


@dataclass
class Believer:
    """A search whose model believes in minus the squared distance from `best_params_`."""

    trials: pd.DataFrame
    bounds: np.ndarray
    best_params_: np.ndarray
    sure: bool = False
    # how much less is expected than of the mean trajectory
    less: float | None = None
    asked: list = field(default_factory=list)

    def history(self):
        return self.trials

    def predict_return(self, params):
        self.asked.append(params)
        off = params - self.best_params_
        std = None if self.sure else 0.1 + np.abs(off).sum(axis=1)
        reward = -(off**2).sum(axis=1)
        return Assessed(reward, std, None if self.less is None else reward - self.less)


def believer(n_params, n_trials=6, *, sure=False, n_logged=0, ended=()):
    rng = np.random.default_rng(0)
    returns = rng.normal(-5, 2, n_trials)
    proposed = np.arange(n_trials) >= max(n_logged, 1)
    params = rng.uniform(0, 2, (n_trials, n_params))
    trials = pd.DataFrame({"trial": np.arange(n_trials)})
    for i in range(n_params):
        trials[f"gain_{i}"] = params[:, i]
    trials["return"] = returns
    trials["best"] = np.maximum.accumulate(returns)
    trials["predicted"] = np.where(proposed, returns + 0.5, NAN)
    trials["expected"] = NAN
    trials["predicted_std"] = NAN if sure else np.where(proposed, 0.7, NAN)
    trials["terminated"] = np.isin(np.arange(n_trials), ended)
    trials["source"] = ["logged"] * n_logged + ["model"] * (n_trials - n_logged)
    bounds = np.tile([0.0, 2.0], (n_params, 1)) + np.arange(n_params)[:, None] * 0.1
    return Believer(trials, bounds, np.full(n_params, 1.3), sure=sure)


def points(ax):
    """What the legend names: label to (n, 2) points."""
    return {
        line.get_label(): line.get_xydata()
        for line in ax.get_lines()
        if not line.get_label().startswith("_")
    }


def trial_of(gain, n_steps=3):
    return Trajectory(np.full((n_steps + 1, 1), gain), params=[gain])


# -- plot_search --------------------------------------------------------------------------


def test_every_trial_is_drawn_once_where_history_says():
    search = believer(2, 9, n_logged=4, ended=(1, 2, 6))
    of = points(plot_search(search))
    drawn = {"logged": [0, 3], "logged, ended early": [1, 2]}
    drawn |= {"trial": [4, 5, 7, 8], "trial, ended early": [6]}
    returns = search.trials["return"].to_numpy()
    for label, trials in drawn.items():
        assert_allclose(of[label], np.column_stack([trials, returns[trials]]))
    assert_allclose(of["best so far"][:, 1], np.maximum.accumulate(returns))
    assert set(of) == {*drawn, "best so far"}


def test_kinds_of_trials_differ_without_colour():
    ax = plot_search(believer(2, 9, n_logged=4, ended=(1, 2, 6)))
    looks = {
        (line.get_marker(), line.get_markerfacecolor() == "white")
        for line in ax.get_lines()
        if "best" not in line.get_label() and not line.get_label().startswith("_")
    }
    assert len(looks) == 4


def test_error_bars_are_predictions_beside_their_trials():
    search = believer(1, 5)
    (bar,) = plot_search(search).containers
    centres, _, (spans,) = bar
    assert bar.get_label() == "predicted"
    known = np.isfinite(centres.get_ydata())
    assert known.tolist() == [False, True, True, True, True]
    assert_allclose(centres.get_ydata()[known], search.trials["return"][1:] + 0.5)
    assert (np.abs(centres.get_xdata() - np.arange(5)) < 0.5).all()
    lengths = [np.ptp(s[:, 1]) for s in spans.get_segments() if len(s) and np.isfinite(s).all()]
    assert_allclose(lengths, 2 * 0.7)


def test_error_bars_are_about_the_expected_return():
    search = believer(1, 5)
    search.trials["expected"] = search.trials["predicted"] - [0.0, 0.0, 0.0, 0.3, 0.3]
    ax = plot_search(search)
    (bar,) = ax.containers
    assert_allclose(bar[0].get_ydata(), search.trials["expected"])
    dashes = points(ax)["predicted, of the mean trajectory"]
    assert_allclose(dashes[:, 1], search.trials["predicted"][3:])
    assert_array_equal(dashes[:, 0], bar[0].get_xdata()[3:])
    search.trials["expected"] = search.trials["predicted"]
    assert "predicted, of the mean trajectory" not in points(plot_search(search))


def test_predictions_without_a_standard_deviation_have_no_bars():
    (bar,) = plot_search(believer(1, 5, sure=True)).containers
    assert not bar.has_yerr
    assert np.isfinite(bar[0].get_ydata()).sum() == 4


def test_no_prediction_no_word_of_it():
    ax = plot_search(believer(1, 4, n_logged=4))
    assert not ax.containers
    assert set(points(ax)) == {"best so far", "logged"}


def test_a_single_trial_can_be_drawn():
    ax = plot_search(believer(1, 1, n_logged=1))
    assert_array_equal(points(ax)["logged"][:, 0], [0])
    assert all(tick == int(tick) for tick in ax.get_xticks())


def test_trials_without_a_return_are_left_out():
    search = believer(1, 3)
    search.trials.loc[0, ["return", "best"]] = NAN
    drawn = points(plot_search(search))["trial"]
    assert np.isfinite(drawn[:, 1]).tolist() == [False, True, True]


def test_a_search_of_each_class_can_be_drawn():
    for kind in (RandomSearch, BayesianSearch):
        search = kind(bounds=[[0, 1]], reward=lambda s: -s[..., 0], horizon=3, random_state=0)
        with pytest.raises(AttributeError, match=r"ask\(\) or tell\(\) first"):
            plot_search(search)
        search.tell([trial_of(0.3), trial_of(0.2)])
        _, axes = plt.subplots()
        assert plot_search(search, axes) is axes
        assert_allclose(points(axes)["best so far"][:, 1], [-0.9, -0.6])


def test_a_history_without_trials_is_refused():
    search = believer(1, 3)
    search.trials = search.trials[:0]
    with pytest.raises(ValueError, match="no trial yet"):
        plot_search(search)


# -- plot_slices --------------------------------------------------------------------------


@pytest.mark.parametrize("n_params", [1, 4, 15])
def test_slices_go_through_the_best_params(n_params):
    search = believer(n_params)
    panels = plot_slices(search, n_points=21)
    assert panels.shape == (n_params,)
    (asked,) = search.asked  # one batch: one fit, one prediction
    assert asked.shape == (21 * n_params, n_params)
    for i, ax in enumerate(panels):
        assert ax.get_xlabel() == f"gain_{i}"
        x, y = ax.get_lines()[0].get_data()
        assert_allclose(x, np.linspace(*search.bounds[i], 21))
        assert_allclose(y, -((x - 1.3) ** 2))
        assert_allclose(ax.get_lines()[1].get_xdata(), 1.3)
        others = np.delete(asked[21 * i : 21 * (i + 1)], i, axis=1)
        assert_allclose(others, 1.3)
    rows = {round(ax.get_position().y0, 3) for ax in panels}
    assert sum(ax.get_ylabel() == "predicted return" for ax in panels) == len(rows)
    assert len(panels[0].figure.axes) == n_params  # no empty panels


def test_the_band_is_one_standard_deviation():
    ax = plot_slices(believer(2), n_points=11)[1]
    (band,) = ax.collections
    x, y = ax.get_lines()[0].get_data()
    corners = band.get_paths()[0].vertices
    for at, mean in zip(x, y):
        here = corners[np.isclose(corners[:, 0], at), 1]
        assert_allclose([here.min(), here.max()], mean + np.array([-1, 1]) * (0.1 + abs(at - 1.3)))


@pytest.mark.parametrize("given", [False, True])
def test_the_band_is_about_the_expected_return(given):
    search = believer(2)
    search.less = 0.4
    axes = plt.subplots(1, 2)[1] if given else None
    panels = plot_slices(search, n_points=11, axes=axes)
    for ax in panels:
        (band,) = ax.collections
        expected, mean_path = ax.get_lines()[:2]
        assert_allclose(expected.get_ydata(), mean_path.get_ydata() - 0.4)
        corners = band.get_paths()[0].vertices
        for at, value in expected.get_xydata():
            here = corners[np.isclose(corners[:, 0], at), 1]
            assert_allclose((here.min() + here.max()) / 2, value)
    figure = panels[0].figure
    (legend,) = [panels[0].get_legend()] if given else figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "expected",
        "of the mean trajectory",
    ]


def test_no_legend_where_both_are_the_same():
    search = believer(1)
    search.less = 0.0
    (ax,) = plot_slices(search, n_points=5)
    assert not ax.figure.legends
    assert "of the mean trajectory" not in points(ax)


def test_no_band_where_the_model_gives_no_standard_deviation():
    assert not any(ax.collections for ax in plot_slices(believer(2, sure=True), n_points=5))


def test_ticks_are_the_values_tried_within_the_range():
    search = believer(1)
    search.trials["gain_0"] = [0.0, 0.5, 2.0, 7.0, -1.0, NAN]  # the last ran with several
    (ax,) = plot_slices(search, n_points=5)
    assert_allclose(ax.get_lines()[2].get_xdata(), [0.0, 0.5, 2.0])
    low, high = ax.get_xlim()
    assert -0.5 < low < 0
    assert 2 < high < 2.5


def test_slices_through_other_params_may_lie_outside_the_bounds():
    search = believer(2)
    panels = plot_slices(search, [1.0, 2.5], n_points=5)
    assert_allclose(search.asked[0][:5, 1], 2.5)
    assert panels[1].get_xlim()[1] > 2.5
    assert panels[0].get_xlim()[1] < 2.5


def test_slices_are_drawn_into_given_axes():
    _, axes = plt.subplots(1, 3)
    panels = plot_slices(believer(3), n_points=5, axes=axes)
    assert all(a is b for a, b in zip(panels, axes, strict=True))
    assert [ax.get_ylabel() for ax in panels] == ["predicted return", "", ""]
    _, own = plt.subplots()
    assert plot_slices(believer(1), n_points=5, axes=own)[0] is own


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"params": [1.0]}, r"params has shape \(1,\); expected \(2,\)"),
        ({"params": [1.0, NAN]}, "params has NaN"),
        ({"n_points": 1}, "n_points = 1 must be at least 2"),
    ],
)
def test_what_cannot_be_sliced(given, message):
    with pytest.raises(ValueError, match=message):
        plot_slices(believer(2), **given)
    assert not plt.get_fignums()


def test_a_wrong_number_of_axes_is_refused():
    _, axes = plt.subplots(1, 3)
    with pytest.raises(ValueError, match="3 axes for 2 parameters"):
        plot_slices(believer(2), axes=axes)


def test_a_search_without_a_model_has_no_slices():
    search = RandomSearch(bounds=[[0, 1]], reward=lambda s: -s[..., 0], horizon=3)
    with pytest.raises(TypeError, match=r"RandomSearch has no model .* use plot_search"):
        plot_slices(search.tell(trial_of(0.3)))


def test_slices_of_a_real_search_agree_with_its_predictions():
    from sklearn.linear_model import LinearRegression

    from trajlearn import OneStepRegressor

    rng = np.random.default_rng(0)
    trials = [
        Trajectory((1 - gain) ** np.arange(6)[:, None], params=[gain])
        for gain in rng.uniform(0, 1, 5)
    ]
    search = PolicySearch(
        OneStepRegressor(LinearRegression(), inputs="params"),
        bounds=[[0.0, 1.0]],
        reward=lambda states: -np.abs(states[..., 0]),
        horizon=5,
        random_state=0,
    ).tell(trials)
    (ax,) = plot_slices(search, n_points=7)
    x, y = ax.get_lines()[0].get_data()
    assert_allclose(y, search.predict_return(x[:, None]).reward)
    assert_allclose(ax.get_lines()[1].get_xdata(), search.best_params_[0])


def test_without_matplotlib_the_error_names_the_extra(monkeypatch):
    search = believer(1)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    for plot in (plot_search, plot_slices):
        with pytest.raises(ImportError, match=rf"{plot.__name__}.*trajlearn\[plot\]"):
            plot(search)
    monkeypatch.undo()
