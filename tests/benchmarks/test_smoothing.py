"""The smoothing benchmark: its cells on a few short episodes, its text on made-up tables."""

import warnings

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import make_pipeline

from benchmarks.paper import _models, _smoothing_page, _tasks, smoothing
from benchmarks.paper._command import Run
from benchmarks.paper._rollouts import N_TEST, expected_warnings, windows
from trajlearn.exceptions import SmoothingWarning

pytestmark = pytest.mark.filterwarnings("ignore::trajlearn.exceptions.SmoothingWarning")
INF = np.inf
LENGTH = 60


@pytest.fixture(autouse=True)
def no_figure_left():
    yield
    plt.close("all")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(_tasks.TASKS, "cartpole", _tasks.Task(LENGTH, 2 * LENGTH))
    monkeypatch.setattr(_tasks, "N_EPISODES", 8)
    monkeypatch.setitem(N_TEST, "quick", 4)
    monkeypatch.setattr(_models, "QUICK_STEPS", 10)
    monkeypatch.setattr(smoothing, "MODELS", ["C", "D"])


def forecast_cell(states, noise=0.05, seed=0):
    smoothed = states == "smoothed"
    return smoothing.forecast_cell(
        "cartpole", noise, states, "velocity" if smoothed else None, smoothed, "quick", seed
    )


# -- cells ----------------------------------------------------------------------------------------


def test_noise_is_new_for_every_seed_and_for_test_episodes(small):
    true, test, noisy, seen = smoothing.measured("cartpole", 0.1, 0, mode="quick")
    for clean, some in ((true, noisy), (test, seen)):
        off = (some.states - clean.states) / clean.states.std(axis=0)
        assert off.std(axis=0) == pytest.approx(0.1, rel=0.3)
    n = 50
    noises = [(some.states - clean.states)[:n] for clean, some in ((true, noisy), (test, seen))]
    other = smoothing.measured("cartpole", 0.1, 1, mode="quick")
    noises.append((other[2].states - other[0].states)[:n])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(noises[i][:, 0], noises[j][:, 0])[0, 1]) < 0.6
    again = smoothing.measured("cartpole", 0.1, 0, mode="quick")
    np.testing.assert_array_equal(again[2].states, noisy.states)
    assert np.shape(test.states) == (4 * (LENGTH + 20 + 1), 4)


def test_a_state_cell_has_the_errors_of_the_same_training_episodes(small):
    result = smoothing.state_cell("cartpole", 0.05, "velocity", True, 3)
    true, _, noisy, _ = smoothing.measured("cartpole", 0.05, 3, mode="quick")
    kalman = smoothing.smoother("cartpole", "velocity", True)
    assert kalman.velocities == {"x": "x_dot", "theta": "theta_dot"}
    smooth = kalman.fit_transform(noisy)
    assert result["state"] == ["x", "x_dot", "theta", "theta_dot"]
    for j in range(4):
        std = true.states[:, j].std()
        for column, some in (("raw", noisy), ("smoothed", smooth)):
            off = some.states[:, j] - true.states[:, j]
            assert result[column][j] == pytest.approx(np.sqrt((off**2).mean()) / std)
    # the filter knows less than the smoother, and both more than one measurement
    assert result["smoothed"][0] < result["filtered"][0] < result["raw"][0]
    assert result["estimated_noise"][0] == pytest.approx(0.05, rel=0.3)


def test_warnings_go_to_the_states_that_they_name(small):
    clean = smoothing.state_cell("cartpole", 0.0, "velocity", False, 0)
    assert clean["warned"] == [True] * 4
    assert max(clean["smoothed"]) < 1e-3
    _, _, noisy, _ = smoothing.measured("cartpole", 0.05, 0, mode="quick")
    kalman = smoothing.smoother("cartpole", "velocity", False)
    true, smooth = noisy, kalman.fit_transform(noisy)
    texts = ["smoothing moves x_dot by 2 (noise 1): more than noise explains"]
    found = smoothing.state_errors(kalman, true, noisy, smooth, texts)
    assert found["warned"] == [False, True, False, False]


def test_only_warnings_of_the_smoother_are_kept(small):
    class Loud:
        def fit_transform(self, some):
            warnings.warn("one", SmoothingWarning, stacklevel=1)
            warnings.warn("two", UserWarning, stacklevel=1)
            return some

    assert smoothing.fitted(Loud(), "episodes") == ("episodes", ["one"])


def test_a_smoothed_cell_forecasts_as_a_pipeline_does(small, monkeypatch):
    monkeypatch.setattr(smoothing, "MODELS", ["D"])
    result = forecast_cell("smoothed")
    true, test, noisy, seen = smoothing.measured("cartpole", 0.05, 0, mode="quick")
    policy = _tasks.environment("cartpole").policy
    model = make_pipeline(
        smoothing.smoother("cartpole", "velocity", True),
        _models.build("D", "default", policy=policy, mode="quick", seed=0),
    ).fit(noisy)
    extent = np.ptp(true.states, axis=0)
    for start in smoothing.STARTS:
        with expected_warnings():
            guess = np.asarray(model.predict(seen, start=start, horizon=LENGTH, actions="policy"))
        truth = np.stack([episode.states[start + 1 : start + 1 + LENGTH] for episode in test])
        errors = (((guess - truth) / extent) ** 2).mean(axis=2)
        far = errors[:, windows(LENGTH)["long"]].mean(axis=1)
        asked = ("policy", start, "long")
        lines = result["errors"]
        (line,) = [i for i in lines if (i["actions"], i["start"], i["window"]) == asked]
        assert line["median"] == pytest.approx(np.median(far))
        assert (line["n_diverged"], line["n_episodes"]) == (0, 4)


def test_training_on_true_states_still_starts_from_measured_ones(small):
    raw, true = forecast_cell("raw"), forecast_cell("true")
    assert raw["starts"] == true["starts"]
    assert min(raw["starts"].values()) > 0.01
    assert raw["errors"] != true["errors"]
    assert raw["states"] is None
    clean = forecast_cell("raw", noise=0.0)
    assert set(clean["starts"].values()) == {0.0}


def test_the_run_chooses_a_smoother_and_repeats_none(small, monkeypatch, tmp_path):
    asked = []

    def cells(self, cells, function, **_):
        asked.extend((function.__name__, cell) for cell in cells)
        return [function(**cell) for cell in cells]

    def choice(task, fused, noise, seed):
        assert seed not in range(20)
        return {"x": "acceleration", "theta": "acceleration"}

    monkeypatch.setattr(Run, "cells", cells)
    monkeypatch.setattr(smoothing, "choice_cell", choice)
    monkeypatch.setattr(smoothing, "NOISE", {"quick": [0.0, 0.05]})
    tables = smoothing.run(Run("smoothing", "quick", [0], tmp_path, 1, {}))
    forecasts = [cell for name, cell in asked if name == "forecast_cell"]
    assert [(cell["noise"], cell["states"]) for cell in forecasts] == [
        (0.0, "raw"),
        (0.0, "smoothed"),
        (0.05, "raw"),
        (0.05, "smoothed"),
        (0.05, "true"),
    ]
    assert {cell["model"] for cell in forecasts} == {None, "acceleration"}
    used = tables["states"].query("used")
    assert set(used["smoother"]) == {"acceleration, fused"}
    # every smoother once for every noise and state
    keys = ["smoother", "noise", "state"]
    assert not tables["states"].duplicated(keys).any()
    assert len(tables["states"]) == 4 * 2 * 4
    assert len(tables["errors"]) == 5 * 3 * 2 * 2
    text = smoothing.report(tables)
    assert "Smoother: acceleration, fused" in text
    assert "prefers this model in 2 of 2 filters" in text
    assert "it warns of 4 of 4 states" in text
    assert "Horizons 51 to 60 (long)" in text
    figures = smoothing.draw(tables)
    assert set(figures) == {"smoothing-states", "smoothing-short", "smoothing-long"}


def test_the_choice_is_the_smoother_s(small):
    found = smoothing.choice_cell("cartpole", True, 0.05, smoothing.CHOICE_SEED)
    assert set(found) == {"x", "theta"}
    assert set(found.values()) <= {"velocity", "acceleration"}


# -- text and figures -----------------------------------------------------------------------------


def errors_of(table, line="C", window="long"):
    """A table of errors from {(states, noise): errors by seed}."""
    lines = [
        {"task": "cartpole", "noise": noise, "states": states, "seed": seed, "model": line}
        | {"actions": "none", "line": line, "start": 0, "window": window, "median": error}
        | {"mean": error, "n_diverged": int(np.isinf(error)), "n_episodes": 4}
        for (states, noise), errors in table.items()
        for seed, error in enumerate(errors)
    ]
    return pd.DataFrame(lines)


def some_errors(smoothed, raw=(100.0, 100.0)):
    return errors_of(
        {
            ("raw", 0.0): [1.0, 1.0],
            ("smoothed", 0.0): [1.0, 1.0],
            ("raw", 0.1): raw,
            ("smoothed", 0.1): smoothed,
            ("true", 0.1): [2.0, 2.0],
        }
    )


def test_half_of_the_cost_in_logarithms_is_given_back():
    errors = some_errors([10.0, 10.0])
    costs = _smoothing_page.cost(errors)
    assert costs["raw"].tolist() == [100.0, 100.0]
    assert costs["gain"].tolist() == [10.0, 10.0]
    assert costs["share"].tolist() == pytest.approx([0.5, 0.5])
    (line,) = _smoothing_page.cost_table(errors).to_dict("records")
    assert (line["measured"], line["smoothed"], line["true"]) == ("x 100", "x 10", "x 2")
    assert line["given back"] == "50%"


def test_nothing_is_given_back_where_noise_costs_nothing():
    errors = some_errors([0.5, 0.5], raw=(1.1, 1.1))
    assert _smoothing_page.cost_table(errors)["given back"].tolist() == [None]


@pytest.mark.parametrize(
    ("smoothed", "verdict"),
    [
        ([50.0, 90.0], "lowers the error at 10 % noise"),
        ([150.0, 120.0], "raises the error at 10 % noise"),
        ([50.0, 150.0], "makes no difference that all seeds share at 10 % noise"),
        ([99.0, 100.0], "makes no difference that all seeds share at 10 % noise"),
        ([INF, INF], "raises the error at 10 % noise"),
    ],
)
def test_the_verdict_asks_every_seed(smoothed, verdict):
    (said,) = _smoothing_page.verdicts(some_errors(smoothed))
    assert said == f"- C, from state 0: smoothing {verdict}."


def test_what_diverged_is_infinite_and_named():
    errors = some_errors([INF, INF])
    table = _smoothing_page.error_table(errors)
    assert table["trained on"].tolist() == ["measured", "smoothed", "true"]
    assert table["10 %"].tolist() == ["100 (100 to 100)", "inf (inf to inf)", "2 (2 to 2)"]
    assert table["0 %"].tolist()[2] == ""
    said = _smoothing_page._diverged(errors)[0]
    assert said == "Diverged (infinite): C on smoothed states, 10 %: 2 of 8."


def test_a_damped_model_is_no_merit_of_noise():
    lower = some_errors([0.2, 0.2], raw=(0.1, 0.1))
    assert not _smoothing_page._damped(lower)
    said = _smoothing_page._damped(lower.assign(line="D, logged"))
    assert "(D, logged)" in said[0]
    assert not _smoothing_page._damped(some_errors([1.0, 1.0]).assign(line="D, logged"))


def states_of(smoothed, noise=0.1):
    """A table of states from {state: errors by seed in units of the noise}."""
    return pd.DataFrame(
        [
            {"task": "reacher", "noise": noise, "smoother": "velocity", "used": True, "seed": seed}
            | {"state": state, "raw": noise, "filtered": noise, "smoothed": noise * error}
            | {"estimated_noise": 2 * noise, "warned": False}
            for state, errors in smoothed.items()
            for seed, error in enumerate(errors)
        ]
    )


def test_sentences_tell_help_from_harm():
    states = states_of({"a": [0.2, 0.3], "b": [1.5, 1.2], "c": [0.5, 1.5], "d": [1.0, 1.0]})
    (said,) = _smoothing_page.state_sentences(states)
    assert "lowers the error of a (to between 0.2 and 0.3 of the noise)" in said
    assert "raises the error of b (to between 1.2 and 1.5 of the noise)" in said
    assert said.endswith("for every seed, that of c, d.")


def test_many_states_are_shown_by_kind():
    names = [f"{kind}_{i}" for kind in ("cos", "sin", "velocity") for i in range(4)]
    states = states_of({name: [0.5 + 0.1 * name.startswith("sin")] for name in names})
    table = _smoothing_page.state_table(states)
    assert table["state"].tolist() == ["cos", "sin", "velocity"]
    assert table["smoothed, 10 %"].tolist() == ["0.5", "0.6", "0.5"]
    assert table["estimated, 10 %"].tolist() == ["2"] * 3
