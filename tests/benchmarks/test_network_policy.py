"""Models of networks' weights, on a few episodes; text and figures on made-up scores."""

import json

import numpy as np
import pandas as pd
import pytest
from sklearn.linear_model import LinearRegression

from benchmarks.paper import _models, _network_models, network_policy
from benchmarks.paper._command import read_tables
from benchmarks.paper._network_figures import draw
from benchmarks.paper._network_models import (
    INPUT_SCALE,
    LENGTH,
    MODELS,
    N_PROBES,
    POLICY,
    TASK,
    WINDOWS,
    _errors,
    bounds,
    flown,
    make,
    probes,
    true_returns,
)
from benchmarks.paper._network_page import report
from trajlearn import OneStepRegressor


@pytest.fixture
def small(monkeypatch):
    flown.cache_clear()
    monkeypatch.setattr(_models, "QUICK_STEPS", 15)
    monkeypatch.setattr(_network_models, "_GP_ITERATIONS", 5)
    monkeypatch.setitem(_network_models.N_LOGGED, "quick", [20])
    monkeypatch.setitem(_network_models.N_HELD_OUT, "quick", 25)
    monkeypatch.setitem(_network_models.N_EVALUATIONS, "quick", 10)
    for use in ("assess", "search", "proposal"):
        monkeypatch.setitem(_network_models.N_STARTS, use, 2)
    yield
    flown.cache_clear()


def test_everything_comes_out(small, tmp_path, capsys):
    options = ["--quick", "--n-jobs", "1", "--out", str(tmp_path)]
    network_policy.BENCHMARK.main(options)
    assert "quick mode" in capsys.readouterr().out
    folder = tmp_path / "network-policy"
    assert json.loads((folder / "network-policy.json").read_text())["settings"]["n_probes"] == 8
    tables = read_tables(folder, "network-policy")
    scores = tables["scores"].set_index("model")
    assert set(scores.index) == set(MODELS)
    assert scores["found"].between(0, 1).all()
    assert scores.loc["D, policy", "rank"] > scores.loc["T, weights", "rank"]
    # the constant ranks nothing, the simulator predicts no others
    assert scores["rank"].isna().sum() == 2
    assert set(tables["errors"]["model"]) == {"T, weights", "T, responses", "D, policy"}
    # every search begins at the best logged networks, so that with the truth it never loses
    assert scores.loc["simulator", "promised"] > 0
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    network_policy.BENCHMARK.main([*options, "--redraw"])
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


# -- episodes and models --------------------------------------------------------------------------


def test_what_enters_the_hidden_units_is_of_order_one():
    low, high = bounds().T
    assert len(high) == POLICY.n_params == 31
    np.testing.assert_array_equal(low, -high)
    # each hidden unit has four input weights first, then come the biases
    np.testing.assert_allclose(high[:4] * np.array(INPUT_SCALE), high[0] * INPUT_SCALE[0])
    np.testing.assert_array_equal(high[:4], high[16:20])
    assert np.unique(high[20:25]).tolist() == [high[30]]


def test_falls_are_kept_and_seeds_do_not_meet():
    log, other = flown(40, 0, 0), flown(40, 0, 1)
    assert 0.3 < log.terminated.mean() < 1
    assert (log.lengths[log.terminated] < LENGTH).all()
    assert not np.isin(log.params, other.params).any()
    unscaled = flown(40, 0, 0, scaled=False)
    assert np.abs(unscaled.params).max() <= 1
    assert log.lengths.mean() > unscaled.lengths.mean()


def test_true_returns_average_over_starts():
    weights, starts = np.asarray(flown(3, 0, 0).params), TASK.common_starts[:2]
    singly = [[true_returns(w[None], s[None])[0] for s in starts] for w in weights]
    np.testing.assert_allclose(true_returns(weights, starts), np.mean(singly, axis=1))


def test_probes_are_apart_and_among_the_logged_states():
    log = flown(40, 0, 0)
    at = probes(log)
    assert at.shape == (N_PROBES, 4)
    assert (at >= log.states.min(axis=0)).all()
    assert (at <= log.states.max(axis=0)).all()
    gaps = np.linalg.norm((at[:, None] - at) / log.states.std(axis=0), axis=2)
    assert gaps[~np.eye(N_PROBES, dtype=bool)].min() > 0.3


def test_responses_do_not_see_the_order_of_hidden_units(small):
    log = flown(20, 0, 0)
    model = make(MODELS["GP, responses"], log, "quick", 0)
    order = np.array([4, 2, 0, 1, 3])
    weights = np.asarray(log.params)
    into, bias = weights[:, :20].reshape(-1, 5, 4), weights[:, 20:25]
    swapped = np.concatenate(
        [into[:, order].reshape(-1, 20), bias[:, order], weights[:, 25:30][:, order]], axis=1
    )
    swapped = np.concatenate([swapped, weights[:, 30:]], axis=1)
    assert not np.allclose(swapped, weights)
    np.testing.assert_allclose(
        model.predict(log.assign(params=swapped)), model.predict(log), atol=1e-6
    )


def test_an_episode_counts_in_the_windows_that_it_reaches():
    log, test = flown(20, 0, 0), flown(30, 0, 1)
    model = OneStepRegressor(LinearRegression(), policy=POLICY).fit(log)
    lines = _errors(model, test)
    assert lines["window"] == list(WINDOWS)
    reached = [int((test.lengths >= low).sum()) for low, _ in WINDOWS.values()]
    assert lines["episodes"] == reached
    assert np.isfinite(lines["median"]).all()


# -- text and figures -----------------------------------------------------------------------------


def made_up():
    found = {"T, weights": 0.1, "T, responses": 0.7, "D, policy": 0.98, "GP, weights": 0.2}
    found |= {"GP, responses": 0.5, "constant": 0.6, "simulator": 0.99}
    ranks = {"T, weights": 0.0, "T, responses": 0.8, "D, policy": 0.99, "GP, weights": 0.1}
    scores, errors, returns = [], [], []
    for n in (100, 400):
        for seed in (0, 1, 2):
            for model, true in found.items():
                key = {"model": model, "n": n, "seed": seed}
                stood = 0.1 if model == "constant" else np.nan
                scores.append(
                    key
                    | {"mse": np.nan if model == "simulator" else 0.01 * (1 + seed)}
                    | {"rank": ranks.get(model, np.nan), "found": true, "promised": 0.9}
                    | {"stood": stood, "stood_unscaled": stood / 50, "fit_s": 1.0, "search_s": 2.0}
                )
                if model in ("T, weights", "D, policy"):
                    errors += [
                        key | {"window": w, "median": 0.01, "q95": 0.1, "episodes": 9}
                        for w in WINDOWS
                    ]
                if seed == 0 and model in ranks:
                    returns += [key | {"predicted": p, "true": 0.5} for p in (0.1, 0.9)]
    tables = {"scores": scores, "errors": errors, "returns": returns}
    return {name: pd.DataFrame(lines) for name, lines in tables.items()}


def test_the_text_says_who_wins():
    text = report(made_up())
    assert "| 100 | T, weights | 0.02 (0.01 to 0.03) | 0.00 (0.00 to 0.00) |" in text
    assert "10.0 % of 100 and 10.0 % of 400 logged episodes stand" in text
    assert "with U[-1, 1] as it is, 0.2 % of 100 and 0.2 % of 400." in text
    assert (
        "- 400 episodes: D, policy ranks best (0.99), of those that do not roll the network out "
        "T, responses (0.80). Better networks than the best logged one (0.60) are found on: "
        "D, policy, T, responses. What is found is furthest below its prediction on T, weights "
        "(by 0.80)." in text
    )
    assert "nan" not in text


def test_the_figures_show_every_model():
    import matplotlib.pyplot as plt

    figures = draw(made_up())
    assert len(figures) == 3
    labels = [label.get_text() for label in figures["network-policy"].axes[0].get_yticklabels()]
    assert len(labels) == len(MODELS)
    assert labels[-2:] == ["best logged network", "simulator itself"]
    titles = [ax.get_title(loc="left") for ax in figures["network-policy-returns"].axes]
    assert "D, policy, 400" in titles
    assert len(titles) == 8
    for figure in figures.values():
        plt.close(figure)
