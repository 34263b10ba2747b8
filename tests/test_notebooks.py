"""Notebooks on flights, uncertainty and tuning, run small; all run when the pages are built."""

import json
import os
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from trajlearn.datasets import load_crazyflie_gains

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# What the notebook found, told by one more cell.
FOUND = """
import json
print(json.dumps({
    "n_flights": len(flights),
    "errors": table.to_dict(),
    "ranking": ranking["pooled"].to_dict(),
    "rows": shortlist.index.tolist(),
    "proposed": proposed.tolist(),
    "flown": line.params.tolist(),
    "overlap": [np.intersect1d(flights.group[a], flights.group[b]).tolist() for a, b in folds],
}))
"""


FOUND_OF_UNCERTAINTY = """
import json


def coverage(level):
    table = overview(reports, "coverage").xs(f"{level:g}", level="level").droplevel("measure")
    return {name: row.tolist() for name, row in table.iterrows()}


print(json.dumps({
    "n_episodes": [len(episodes), len(train), len(test)],
    "in both": np.intersect1d(chosen, held_back).tolist(),
    "n_steps": int(test.lengths.max()),
    "coverage": {level: coverage(level) for level in levels},
    "bands": rows,
    "reward": table,
    "trust": {" / ".join(key): value for key, value in answers.items()},
    "schemes": {name: by_scheme[name]["value"].tolist() for name in by_scheme},
    "infinite": [bool(np.isinf(upper).all()), str(caught[0].message)],
    "cases": {name: overview({name: r}, "coverage").min(axis=None) for name, r in found.items()},
}, default=float))
"""

FOUND_OF_TUNING = """
import json

try:
    asked = careful.ask().tolist()
except UnsafeProposalError:
    asked = None
print(json.dumps({
    "log": search.returns_[: len(log)].tolist(),
    "trials": search.returns_[len(log) :].tolist(),
    "gains": search.history()[list(plant.param_names)][len(log) :].to_numpy().tolist(),
    "bounds": bounds.tolist(),
    "n_forecasts": len(forecasts),
    "on track": bool(furthest < 0.5),
    "asked on a short track": asked,
    "best": {" ".join(map(str, index)): row.tolist() for index, row in best.iterrows()},
    "resumed": np.array_equal(search.ask(), waiting),
    "planning": rows,
}, default=float))
"""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_stored(path):
    cells = nbformat.read(path, as_version=4).cells
    code = [cell for cell in cells if cell.cell_type == "code"]
    assert code
    assert not any(cell.outputs or cell.execution_count for cell in code)


def told_by(name, last_cell, settings):
    """What a last cell of its own prints about a notebook; an error in a cell is an error here."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(last_cell))
    client = NotebookClient(notebook, timeout=300, kernel_name="python3")
    client.execute(env=os.environ | settings)
    told = "".join(o.text for o in notebook.cells[-1].outputs if o.get("name") == "stdout")
    return json.loads(told)


@pytest.fixture(scope="module")
def found(data_folder):
    """Results of the notebook on 40 flights."""
    folder = data_folder("crazyflie_lee_gains").parent
    settings = {"TRAJLEARN_FLIGHTS": str(folder), "TRAJLEARN_NOTEBOOK_FLIGHTS": "40"}
    return told_by("real_flights", FOUND, settings)


@pytest.fixture(scope="module")
def uncertainty():
    """Results of the notebook on 110 short episodes."""
    settings = {"TRAJLEARN_NOTEBOOK_EPISODES": "110"}
    return told_by("uncertainty", FOUND_OF_UNCERTAINTY, settings)


@pytest.fixture(scope="module")
def tuning():
    """Results of the notebook with one repeat."""
    return told_by("tune_a_controller", FOUND_OF_TUNING, {"TRAJLEARN_NOTEBOOK_REPEATS": "1"})


def test_real_flights_runs_on_a_few(found):
    assert found["n_flights"] == 40
    assert set(found["errors"]) == {"mean flight", "T", "T without gains", "C"}
    errors = [mm for by_horizon in found["errors"].values() for mm in by_horizon.values()]
    assert all(0 < mm < 500 for mm in errors)
    # the state at the start tells more of the next step than any mean
    assert found["errors"]["T"]["1"] < found["errors"]["mean flight"]["1"]
    assert all(-1 <= rho <= 1 for rho in found["ranking"].values())


def test_no_experiment_is_both_in_training_and_in_a_test_block(found):
    assert found["overlap"] == [[]] * len(found["overlap"])


def test_proposed_gains_lie_between_flown_ones(found, data_folder):
    proposed, flown = np.array(found["proposed"]), np.array(found["flown"])
    assert 1 <= len(proposed) <= 5
    assert found["rows"] == ["best flown", *(f"try {i + 1}" for i in range(len(proposed)))]
    assert (proposed >= flown.min(axis=0)).all()
    assert (proposed <= flown.max(axis=0)).all()
    # not by the notebook's own account alone
    ds = load_crazyflie_gains(data_folder("crazyflie_lee_gains"), kinds="line_y")
    assert (flown[:, None] == ds.params).all(axis=2).any(axis=1).all()
    # and none is a flown setting again
    assert not (proposed[:, None] == flown).all(axis=2).any()


def test_uncertainty_splits_by_episode(uncertainty):
    n, n_train, n_test = uncertainty["n_episodes"]
    assert n == n_train + n_test == 110
    assert n_test >= 29  # fewer could not show 90 % with a confidence of 95 %
    assert uncertainty["in both"] == []


def test_calibrated_intervals_hold_what_they_promise_better_than_raw_ones(uncertainty):
    off = {
        name: np.mean(
            [
                np.abs(np.array(by_model[name]) - float(level)).mean()
                for level, by_model in uncertainty["coverage"].items()
            ]
        )
        for name in uncertainty["coverage"]["0.9"]
    }
    assert set(off) == {
        f"{model}, {kind}" for model in ("T", "PE") for kind in ("raw", "calibrated")
    }
    for model in ("T", "PE"):
        assert off[f"{model}, calibrated"] < off[f"{model}, raw"]
        at_90 = uncertainty["coverage"]["0.9"][f"{model}, calibrated"]
        assert all(0.75 < share < 1 for share in at_90)


def test_only_a_simultaneous_band_holds_whole_episodes(uncertainty):
    marginal, simultaneous = (uncertainty["bands"][b] for b in ("marginal", "simultaneous"))
    whole = "episodes inside all the way"
    assert marginal[whole] < 0.3
    assert simultaneous[whole] > 0.7
    (width,) = [name for name in marginal if name.startswith("mean width")]
    assert simultaneous[width] > marginal[width] > 0


def test_rewards_need_whole_trajectories(uncertainty):
    for values in uncertainty["reward"].values():
        assert values["calibrated"] > 0.6 > values["calibrated, steps shuffled"]


def test_trust_horizons_of_the_notebook(uncertainty):
    n_steps, trust = uncertainty["n_steps"], uncertainty["trust"]
    assert len(trust) == 2 * 4
    for answer in trust.values():
        steps, easier = answer["steps, 90 % of episodes"], answer["steps, 80 % of episodes"]
        assert 0 <= steps <= easier <= n_steps
        assert steps == int(steps)
        assert answer["seconds"] == pytest.approx(0.02 * steps)
        assert answer["ends by"] in {"tolerance", "episodes", "forecast"}
    for model in ("T", "PE"):
        of_model = {
            name.removeprefix(f"{model} / "): answer["steps, 90 % of episodes"]
            for name, answer in trust.items()
            if name.startswith(f"{model} / ")
        }
        single = [steps for name, steps in of_model.items() if "±" in name]
        assert of_model["all of these"] <= min(single)
    assert max(answer["steps, 90 % of episodes"] for answer in trust.values()) > 0


def test_propagations_and_pitfalls_of_the_notebook(uncertainty):
    schemes = uncertainty["schemes"]
    assert set(schemes) == {"tsinf", "ts1", "expectation", "moment", "unscented"}
    assert len({tuple(values) for values in schemes.values()}) == len(schemes)
    infinite, warning = uncertainty["infinite"]
    assert infinite
    assert "19 or more calibration episodes" in warning
    assert all(0.7 < share <= 1 for share in uncertainty["cases"].values())


def test_four_trials_are_far_better_than_twenty_logged_ones(tuning):
    assert len(tuning["log"]) == 20
    assert len(tuning["trials"]) == tuning["n_forecasts"] == 4
    assert max(tuning["trials"]) > 0.75 * max(tuning["log"])  # returns are negative
    low, high = np.transpose(tuning["bounds"])
    gains = np.array(tuning["gains"])
    assert ((gains >= low) & (gains <= high)).all()
    assert len(np.unique(gains, axis=0)) == 4


def test_a_careful_search_of_the_notebook_stays_on_the_track_or_asks_for_nothing(tuning):
    assert tuning["on track"]
    assert tuning["asked on a short track"] is None


def test_searches_of_the_notebook_are_compared_on_the_same_log(tuning):
    best = tuning["best"]
    assert len(best) == 4
    assert len({curve[0] for curve in best.values()}) == 1
    assert all((np.diff(curve) >= 0).all() for curve in best.values())
    final = {name.rsplit(" ", 1)[0]: curve[-1] for name, curve in best.items()}
    assert final["one-step, formula known"] > final["Bayesian optimisation"]


def test_a_search_of_the_notebook_goes_on_where_it_stopped(tuning):
    assert tuning["resumed"]


def test_planning_of_the_notebook(tuning):
    fixed, *planned = tuning["planning"]
    assert "decisions" not in fixed
    assert [row["decisions"] for row in planned] == [100, 10, 10]
    assert all(0 < row["seconds a decision"] < 10 for row in planned)
    assert all(row["return"] > min(tuning["log"]) for row in planned)
