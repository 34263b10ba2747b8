"""The real quadrotor: who is trained on what, what the text says, what the figures show."""

import itertools

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from benchmarks.paper import _models, _trefoil, _trefoil_page
from benchmarks.paper._command import Run
from trajlearn import TrajectoryDataset

LENGTH = 60


def synthetic(n_steps=70):
    """Three flights that follow circles at different speeds, as `load_nanobench_trefoil` has it."""
    times = 0.01 * np.arange(n_steps + 1)
    states, references = [], []
    for speed in (1.0, 1.2, 1.4):
        wave = np.sin(speed * times[:, None] * np.arange(1, 13))
        states.append(wave)
        references.append(np.c_[wave[:, :3], wave[:, 8]])
    flights = ["pid_rep1", "pid_rep2", "pid_rep3"]
    return TrajectoryDataset.from_arrays(
        states,
        actions=[np.cos(flight[:-1, :4]) for flight in states],
        references=references,
        times=[times] * 3,
        time_origin=np.zeros(3),
        context={"controller": ["pid"] * 3},
        group=flights,
        ids=flights,
        state_names=_trefoil.STATES["all"],
    )


@pytest.fixture(autouse=True)
def _no_figure_stays_open():
    yield
    plt.close("all")


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(_trefoil, "load_nanobench_trefoil", lambda *a, **k: synthetic())
    monkeypatch.setattr(_trefoil, "LENGTH", LENGTH)
    monkeypatch.setattr(_trefoil, "STRIDE", 5)
    monkeypatch.setattr(_trefoil, "QUICK_STEPS", 5)
    monkeypatch.setattr(_models, "QUICK_STEPS", 5)


class Recorded:
    """A model that keeps what it was given, and forecasts that nothing changes."""

    def __init__(self):
        self.trained, self.tested = None, []

    def fit(self, ds):
        self.trained = ds
        self.model = _trefoil.HoldForecaster().fit(ds)
        return self

    def predict(self, ds):
        self.tested.append(ds)
        return self.model.predict(ds)


@pytest.fixture
def recorded(tiny, monkeypatch):
    model = Recorded()
    monkeypatch.setattr(_trefoil, "estimator_of", lambda *a, **k: model)
    return model


def ask(model, settings, states="attitude", flight="pid_rep2"):
    return _trefoil.cell(states, model, settings, flight, "quick", 0)


def test_a_flight_that_is_tested_is_not_trained_on(recorded):
    for settings in ("paper", "default"):
        ask("T", settings)
        assert set(recorded.trained.group) == {"pid_rep1", "pid_rep3"}
        assert set(recorded.tested[0].group) == {"pid_rep2"}
        recorded.tested.clear()


def test_what_the_paper_shows_in_sample_is_tested_there_too(recorded):
    assert list(ask("T", "default")["tests"]) == ["held-out"]
    assert list(ask("T", "paper")["tests"]) == ["held-out", "in-sample"]
    assert set(recorded.tested[-1].group) == set(recorded.trained.group)


@pytest.mark.parametrize(
    ("model", "settings", "references", "phase"),
    [
        ("T", "paper", False, False),
        ("T", "default", True, True),
        ("T, no reference", "default", False, False),
        ("mean flight", "baseline", False, True),
        ("hold", "baseline", False, False),
    ],
)
def test_models_know_what_their_names_say(recorded, model, settings, references, phase):
    ask(model, settings)
    for ds in (recorded.trained, *recorded.tested):
        assert (ds.references is not None) == references
        assert np.isfinite(ds.time_origin).all() == phase
        assert not ds.context
        assert ds.state_names == _trefoil.STATES["attitude"]


def test_errors_are_those_of_the_forecast(recorded):
    some = ask("hold", "baseline", states="all")["tests"]["held-out"]
    test, span = recorded.tested[0], np.ptp(recorded.trained.states, axis=0)
    expected = [(((e.states[1:] - e.states[0]) / span) ** 2).mean(axis=1) for e in test]
    shown = [0, *_trefoil.shown_horizons(LENGTH)]
    means = [[e[a:b].mean() for a, b in itertools.pairwise(shown)] for e in expected]
    np.testing.assert_allclose(some["errors"], means)
    np.testing.assert_allclose(
        some["windows"]["short"], [errors[:25].mean() for errors in expected]
    )
    np.testing.assert_allclose(some["windows"]["long"], [errors[50:].mean() for errors in expected])


def test_the_reference_is_a_state():
    states = _trefoil.state_of(np.array([[1.0, 2.0, 3.0, 0.5]]))
    names = _trefoil.STATES["all"]
    assert dict(zip(names, states[0])) == dict.fromkeys(names, 0.0) | {
        "x": 1.0,
        "y": 2.0,
        "z": 3.0,
        "yaw": 0.5,
    }


def test_a_tracking_error_needs_the_position():
    assert ("T, tracking error", "default") in _trefoil.models("all")
    assert ("T, tracking error", "default") not in _trefoil.models("attitude")


def test_all_of_the_paper_s_models_have_the_paper_s_states():
    assert {(model, "paper") for model in _trefoil.PAPER} <= set(_trefoil.models("attitude"))
    assert {("D", "paper"), ("T", "paper")} <= set(_trefoil.models("all"))


def errors_of(model, actions, test, by_flight):
    """Lines of a table of windows: the same error in all of three windows of a flight."""
    return pd.DataFrame(
        {"states": "attitude", "model": model, "actions": actions, "test": test, "seed": 0}
        | {"flight": f"pid_rep{i}", "window": window, "short": error, "long": error}
        for i, error in enumerate(by_flight, start=1)
        for window in range(3)
    )


@pytest.mark.parametrize(
    ("ratios", "verdict"),
    [
        ([5.0, 7.0, 9.0], "the claim holds"),
        ([1.1, 7.0, 9.0], "T is better, by less"),
        ([0.9, 7.0, 9.0], "no side on all flights"),
        ([0.1, 0.2, 0.9], "T is worse"),
        ([np.inf, 7.0, 9.0], "the claim holds"),
    ],
)
def test_the_claim_is_judged_on_every_flight(ratios, verdict):
    assert _trefoil_page.verdict(np.array(ratios)) == verdict


def test_text_has_flights_side_by_side():
    others = [("D", "logged"), ("PE", "logged"), ("LSTM", "logged"), ("hold", "none")]
    tables = [
        errors_of(model, actions, test, [4.0, 6.0, 16.0])
        for model, actions in [*others, ("mean flight", "none")]
        for test in ("held-out", "in-sample")
    ]
    tables += [errors_of("T", "none", test, [1.0, 2.0, 2.0]) for test in ("held-out", "in-sample")]
    text = "\n".join(_trefoil_page.report({"real-episodes": pd.concat(tables)}))
    assert "all of 3 flights" in text
    assert "9 windows" in text
    assert "D, logged 4, 3, 8 (T is better, by less)" in text
    assert "mean flight 4, 3, 8." in text
    assert "| T | none | 2 (1 to 2) |" in text
    assert "0 of 9" in text


def test_a_divergence_is_counted_and_not_dropped():
    table = errors_of("D", "logged", "held-out", [1.0, np.inf, np.inf])
    (line,) = _trefoil_page.summary(table).to_dict("records")
    assert line["diverged"] == "6 of 9"
    assert line[_trefoil_page.TITLES["long"]] == "inf (1 to inf)"


def test_the_whole_of_it_on_tiny_flights(tiny, monkeypatch, tmp_path):
    few = [("hold", "baseline"), ("mean flight", "baseline"), ("T", "default"), ("C", "default")]
    paper = [("D", "paper"), ("T", "paper")]
    monkeypatch.setattr(_trefoil, "models", lambda states: few + paper)
    tables = _trefoil.run(Run("horizon-error", "quick", [0], tmp_path, 1, {}))
    by_window = tables["real-episodes"]
    assert set(by_window["flight"]) == {"pid_rep1", "pid_rep2", "pid_rep3"}
    assert not by_window.drop(columns=["window"]).isna().any().any()
    # the curve holds the windows of all flights: as many as the table of windows has
    assert set(tables["real-curves"]["test"]) == {"held-out", "in-sample"}
    text = "\n".join(_trefoil_page.report(tables))
    assert "T (ours)" in text
    figures = _trefoil_page.draw(tables)
    assert set(figures) == {"horizon-error-quadrotor-real", "state-predictions-quadrotor-real"}
    names = [t.get_text() for t in figures["state-predictions-quadrotor-real"].legends[0].texts]
    assert names == ["truth", "D, logged", "T", "T (ours)"]
    legend = figures["horizon-error-quadrotor-real"].legends[0].texts
    assert {"D, in-sample", "T, in-sample", "mean flight"} <= {t.get_text() for t in legend}


def test_the_picture_is_the_window_with_the_median_error(tiny):
    ds = _trefoil.flights()
    by_window = pd.concat(
        [errors_of("T", "none", test, [3.0, 2.0, 1.0]) for test in ("held-out", "in-sample")]
    )
    # three windows of each flight: the fifth of nine is the second of the flight in the middle
    steps = np.arange(5, LENGTH + 1, 5)
    predicted = {
        ("T", flight): np.full((3, len(steps), 5), i)
        for i, flight in enumerate(["pid_rep1", "pid_rep2", "pid_rep3"])
    }
    table = _trefoil._picture(ds, by_window, predicted)
    assert set(table["window"]) == {"pid_rep2:5"}
    assert set(table["T"]) == {1}
    own = ds.select_states(_trefoil.STATES["attitude"])[ds.ids.tolist().index("pid_rep2:5")]
    np.testing.assert_allclose(table["truth"], own.states[steps].ravel())


@pytest.mark.data
def test_real_flights(data_folder, monkeypatch):
    monkeypatch.setenv("TRAJLEARN_FLIGHTS", str(data_folder(_trefoil.DATA).parent))
    ds = _trefoil.flights()
    assert len(set(ds.group)) == 3
    assert set(ds.lengths) == {_trefoil.LENGTH}
    still = _trefoil.cell("attitude", "hold", "baseline", "pid_rep1", "quick", 0)
    flown = _trefoil.cell("attitude", "mean flight", "baseline", "pid_rep1", "quick", 0)
    long = [np.median(one["tests"]["held-out"]["windows"]["long"]) for one in (still, flown)]
    # the flights are alike: far ahead, their mean says more than the start
    assert long[1] < long[0] / 2
    monkeypatch.setattr(_models, "QUICK_STEPS", 20)
    monkeypatch.setattr(_trefoil, "QUICK_STEPS", 20)
    for model in ("T, tracking error", "C"):
        result = _trefoil.cell("all", model, "default", "pid_rep1", "quick", 0)
        assert np.isfinite(result["tests"]["held-out"]["windows"]["short"]).all()
