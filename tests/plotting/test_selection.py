"""The picture of a selection."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.dynamics.crossing import Off, decays
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.plotting.selection import plot_selection

plt = pytest.importorskip("matplotlib.pyplot")


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()  # whatever cannot be drawn fails here
    plt.close("all")


@pytest.fixture(scope="module")
def selector():
    members = [("early", Off(0.0, 0.2)), ("late", Off(0.2, 0.0)), ("never", Off(0.5, 0.5))]
    return HorizonSelector(members, bandwidth=0.0, random_state=0).fit(decays())


def lines(ax):
    return {
        line.get_label(): line for line in ax.get_lines() if not line.get_label().startswith("_")
    }


def test_each_line_is_a_members_median_error(selector):
    ax = plot_selection(selector)
    table = selector.cv_errors_
    shown = lines(ax)
    assert list(shown) == ["early", "late", "never"]
    for name, line in shown.items():
        median = table.loc[table["member"] == name, "median"]
        assert_allclose(line.get_xydata(), np.stack([np.arange(1, 41), median], axis=1))
    assert ax.get_xscale() == ax.get_yscale() == "log"
    assert "training range = 1" in ax.get_ylabel()


def test_lines_are_broad_where_a_member_is_chosen(selector):
    ax = plot_selection(selector)
    broad = [line for line in ax.get_lines() if line.get_lw() > 5]
    known = [np.isfinite(line.get_ydata()) for line in broad]
    np.testing.assert_array_equal(known[0], np.arange(40) < 10)
    np.testing.assert_array_equal(known[1], np.arange(40) >= 10)
    assert not known[2].any()


def test_the_strip_shows_and_names_who_is_chosen(selector):
    ax = plot_selection(selector)
    (strip,) = ax.child_axes
    named = {text.get_text(): text.get_position()[0] for text in strip.texts}
    assert set(named) == {"early", "late", "chosen"}
    assert 1 < named["early"] < 10.5 < named["late"] < 40
    areas = [patch.get_data() for patch in strip.patches]
    assert len(areas) == 2
    assert_allclose(areas[0].values - areas[0].baseline, np.arange(40) < 10)
    assert_allclose(strip.get_xlim(), ax.get_xlim())
    assert strip.get_xlabel() == "horizon (steps)"


def test_weights_are_stacked():
    members = [("over", Off(0.1, 0.1)), ("under", Off(-0.2, -0.2))]
    model = HorizonSelector(members, rule="blend", random_state=0).fit(decays())
    (strip,) = plot_selection(model).child_axes
    below, above = (patch.get_data() for patch in strip.patches)
    assert_allclose(below.values, 2 / 3, atol=0.05)
    assert_allclose(above.baseline, below.values)
    assert_allclose(above.values, 1.0)


@pytest.mark.filterwarnings("ignore::trajlearn.exceptions.DivergenceWarning")
def test_diverged_members_end_at_the_ceiling():
    members = [("gone", Off(diverges=-1.0)), ("good", Off(0.1, 0.1))]
    model = HorizonSelector(members, random_state=0).fit(decays())
    ax = plot_selection(model, ceiling=50.0)
    assert ax.get_ylim()[1] == 50.0
    assert plot_selection(model).get_ylim()[1] == 100.0


def test_lines_beyond_the_ceiling_are_shown_if_there_are_no_others():
    members = [("far", Off(60.0, 60.0)), ("farther", Off(90.0, 90.0))]
    model = HorizonSelector(members, random_state=0).fit(decays())
    low, high = plot_selection(model).get_ylim()
    least, greatest = model.cv_errors_["median"].agg(["min", "max"])
    assert 100 < low < least < greatest < high


def test_a_single_step_is_seen():
    model = HorizonSelector([("one", Off(0.1))], random_state=0).fit(decays(steps=1))
    assert lines(plot_selection(model))["one"].get_marker() == "."


def test_it_draws_into_given_axes(selector):
    figure, ax = plt.subplots()
    assert plot_selection(selector, ax) is ax
    assert plt.get_fignums() == [figure.number]


def test_an_unfitted_selector_is_refused():
    with pytest.raises(ValueError, match="not fitted"):
        plot_selection(HorizonSelector())
