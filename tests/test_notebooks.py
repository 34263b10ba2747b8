"""The notebook on real flights, run on a few of them; the others run when the pages are built."""

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


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_outputs_are_stored(path):
    cells = nbformat.read(path, as_version=4).cells
    code = [cell for cell in cells if cell.cell_type == "code"]
    assert code
    assert not any(cell.outputs or cell.execution_count for cell in code)


@pytest.fixture(scope="module")
def found(data_folder):
    """Results of the notebook on 40 flights; an error in a cell is an error here."""
    folder = data_folder("crazyflie_lee_gains").parent
    notebook = nbformat.read(ROOT / "notebooks" / "real_flights.ipynb", as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(FOUND))
    client = NotebookClient(notebook, timeout=300, kernel_name="python3")
    own = {"TRAJLEARN_FLIGHTS": str(folder), "TRAJLEARN_NOTEBOOK_FLIGHTS": "40"}
    client.execute(env=os.environ | own)
    told = "".join(o.text for o in notebook.cells[-1].outputs if o.get("name") == "stdout")
    return json.loads(told)


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
