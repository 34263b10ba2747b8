"""One training step of a network 9-250-250-4: ours, scikit-learn's, a plain torch loop, mbrl-lib's.

Each call of a case trains on every row once, through the public or the real training loop of each
library, drawing of batches included; times are divided by the steps taken. All use ReLU, float32
and Adam unless they say otherwise.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from sklearn.neural_network import MLPRegressor
from torch.utils.data import DataLoader, TensorDataset

from benchmarks.speed import _mbrl
from benchmarks.speed._command import (
    Columns,
    Row,
    command_line,
    duration,
    one_thread,
    quartiles,
    result,
    times,
)
from benchmarks.speed._gemm import training_products
from benchmarks.speed._timing import Case, measure
from trajlearn.regressors._batches import drawn_batches
from trajlearn.regressors._ensemble import Ensemble
from trajlearn.regressors._training import Settings

NAME = "train_step"
N_INPUTS, HIDDEN, N_TARGETS = 9, (250, 250), 4
SIZES = (N_INPUTS, *HIDDEN, N_TARGETS)
GOALS = {(64, 1): "4x", (64, 5): "2.5x"}

COLUMNS: Columns = {
    "batch": lambda row: str(row["batch_size"]),
    "members": lambda row: str(row["n_members"]),
    "what": lambda row: row["case"],
    "a step": lambda row: duration(row["seconds"]),
    "GEMM": lambda row: times(row["ratio"]),
    "quartiles": quartiles,
    "goal": lambda row: row["goal"],
}


@dataclass(frozen=True)
class Effort:
    """How much to run."""

    rows: int
    rounds: int
    batch_sizes: Sequence[int] = (64, 256)
    members: Sequence[int] = (1, 5)


EFFORT = {"quick": Effort(rows=6_400, rounds=5), "full": Effort(rows=25_600, rounds=15)}


def run(mode: str, effort: Effort, *, mbrl: bool = False) -> dict[str, Any]:
    """Time every case; the members of an ensemble are compared with as many times the products."""
    # first, because it may fail
    python = _mbrl.interpreter() if mbrl else None
    rows: list[Row] = []
    with one_thread():
        for batch_size in effort.batch_sizes:
            for n_members in effort.members:
                cases = _cases(batch_size, n_members, effort.rows)
                labels = {"batch_size": batch_size, "n_members": n_members}
                rows += measure(cases, rounds=effort.rounds, **labels)
    settings: dict[str, Any] = {"sizes": SIZES, **asdict(effort)}
    if python is not None:
        settings["mbrl"], others = _mbrl.run(python, SIZES, asdict(effort))
        rows = sorted(rows + others, key=lambda row: (row["batch_size"], row["n_members"]))
    return result(NAME, mode, rows, settings)


def _cases(batch_size: int, n_members: int, n_rows: int) -> list[Case]:
    rng = np.random.default_rng(0)
    steps = n_rows // batch_size
    x = torch.from_numpy(rng.normal(size=(n_rows, N_INPUTS)).astype(np.float32))
    y = torch.from_numpy(rng.normal(size=(n_rows, N_TARGETS)).astype(np.float32))
    goal = GOALS.get((batch_size, n_members), "")

    def ours(activation: str, probabilistic: bool) -> Callable[[], object]:
        return _ours(x, y, n_members, batch_size, activation, probabilistic=probabilistic)

    base = training_products(SIZES, n_members, batch_size, steps)
    cases = [
        Case("bare GEMM", base, steps),
        Case("trajlearn", ours("relu", False), steps, goal),
        Case("trajlearn, SiLU (its default)", ours("silu", False), steps, goal),
        Case("trajlearn, probabilistic", ours("relu", True), steps),
    ]
    if n_members == 1:
        cases += [
            Case("scikit-learn MLPRegressor", _scikit_learn(x, y, batch_size), steps),
            Case("torch DataLoader loop", _data_loader(x, y, batch_size), steps),
        ]
    return cases


def _ours(
    x: torch.Tensor,
    y: torch.Tensor,
    n_members: int,
    batch_size: int,
    activation: str,
    *,
    probabilistic: bool,
) -> Callable[[], object]:
    """The loop behind `MLPEnsembleRegressor.fit`, without the checks around it."""
    ensemble = Ensemble(
        N_INPUTS,
        N_TARGETS,
        HIDDEN,
        n_members,
        activation,
        nll_beta=0.5 if probabilistic else None,
        weight_decay=0.0,
        device=torch.device("cpu"),
        seed=0,
    )
    batches = drawn_batches(x, y, None, n_members, batch_size, np.random.default_rng(0))
    n_steps = len(x) // batch_size
    settings = Settings(n_steps, learning_rate=1e-3, schedule="one-cycle", verbose=False)
    return lambda: ensemble.train(batches, settings, None)


def _scikit_learn(x: torch.Tensor, y: torch.Tensor, batch_size: int) -> Callable[[], object]:
    """One pass over the rows by `partial_fit`: its loop with few of its checks."""
    model = MLPRegressor(hidden_layer_sizes=HIDDEN, batch_size=batch_size, random_state=0)
    rows, targets = x.numpy(), y.numpy()

    return lambda: model.partial_fit(rows, targets)


def _data_loader(x: torch.Tensor, y: torch.Tensor, batch_size: int) -> Callable[[], object]:
    """What most research code writes."""
    a, b = HIDDEN
    network = torch.nn.Sequential(
        torch.nn.Linear(N_INPUTS, a),
        torch.nn.ReLU(),
        torch.nn.Linear(a, b),
        torch.nn.ReLU(),
        torch.nn.Linear(b, N_TARGETS),
    )
    optimizer = torch.optim.Adam(network.parameters())
    criterion = torch.nn.MSELoss()
    loader = DataLoader(TensorDataset(x, y), batch_size=batch_size, shuffle=True)

    def one_pass() -> float:
        total = 0.0
        for rows, targets in loader:
            optimizer.zero_grad()
            loss = criterion(network(rows), targets)
            loss.backward()
            optimizer.step()
            total += loss.item()
        return total

    return one_pass


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    flags = {
        "mbrl": "also mbrl-lib's trainer, in an environment of its own (made on first use, minutes)"
    }
    command_line(NAME, __doc__ or "", run, EFFORT, COLUMNS, argv, flags=flags)


if __name__ == "__main__":
    main()
