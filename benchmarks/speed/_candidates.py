"""Candidates x 200 steps on cartpole: what timing predictions and timing decisions share."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from benchmarks.speed._command import (
    Columns,
    Row,
    duration,
    one_thread,
    quartiles,
    result,
    times,
)
from benchmarks.speed._gemm import Products, forward_products
from benchmarks.speed._timing import Case, measure
from trajlearn import MLPEnsembleRegressor

# rows of a block of the bare products, the fastest of those tried
BLOCK = 200
HIDDEN = (250, 250)
#: Steps between those that are predicted in the cases of fewer horizons.
EVERY = 10


@dataclass(frozen=True)
class Effort:
    """How much to run; the models need not be good, only of the right size."""

    rounds: int
    fit_steps: int
    candidates: Sequence[int] = (1, 10, 100, 1000)
    n_steps: int = 200
    min_seconds: float = 0.0


class Timed(Protocol):
    """Fitted models, the sizes of T's network, and cases for n candidates."""

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the network's layers, inputs first."""

    def cases(self, n: int) -> list[Case]:
        """Everything that is timed; the first is the bare products."""


def learner(fit_steps: int, n_members: int = 1) -> MLPEnsembleRegressor:
    """The network of all models."""
    return MLPEnsembleRegressor(
        hidden_layer_sizes=HIDDEN, n_members=n_members, batch_size=128, max_steps=fit_steps
    )


def bare_products(sizes: Sequence[int], n_rows: int) -> Products:
    """Products of a network over all rows, in blocks that stay in cache."""
    return forward_products(sizes, n_rows, min(BLOCK, n_rows))


def columns(rate: str, show: Callable[[Row], str]) -> Columns:
    """Columns of the table; a rate stands before the goal."""
    return {
        "candidates": lambda row: str(row["candidates"]),
        "what": lambda row: row["case"],
        "time": lambda row: duration(row["seconds"]),
        "GEMM": lambda row: times(row["ratio"]),
        "quartiles": quartiles,
        rate: show,
        "goal": lambda row: row["goal"],
    }


def run_candidates(
    name: str, mode: str, effort: Effort, make: Callable[[int, int], Timed]
) -> dict[str, Any]:
    """Fit models by ``make(fit_steps, n_steps)``, and time them for each number of candidates."""
    with one_thread():
        models = make(effort.fit_steps, effort.n_steps)
        rows: list[Row] = []
        for n in effort.candidates:
            rows += measure(
                models.cases(n),
                rounds=effort.rounds,
                min_seconds=effort.min_seconds,
                candidates=n,
            )
    return result(name, mode, rows, {"sizes": models.sizes, "block": BLOCK, **asdict(effort)})
