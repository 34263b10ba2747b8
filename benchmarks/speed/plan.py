"""One planning decision of MPC on cartpole: candidates x 200 steps, with T and one-step models.

Ratios are to the products of T's network over all candidates and steps, one member, in blocks
that stay in cache, whatever the case computes. What MPC adds to a prediction is candidates,
rewards, ends of trajectories and the choice.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from benchmarks.speed._command import (
    Columns,
    Row,
    duration,
    finish,
    one_thread,
    parser,
    quartiles,
    result,
    times,
)
from benchmarks.speed._gemm import forward_products
from benchmarks.speed._timing import Case, measure
from benchmarks.speed.predict import BLOCK, EVERY, HIDDEN
from trajlearn import Cartpole, MLPEnsembleRegressor, OneStepRegressor, TrajectoryRegressor
from trajlearn.control.mpc import MPC

NAME = "plan"

COLUMNS: Columns = {
    "candidates": lambda row: str(row["candidates"]),
    "what": lambda row: row["case"],
    "time": lambda row: duration(row["seconds"]),
    "GEMM": lambda row: times(row["ratio"]),
    "quartiles": quartiles,
    "decisions/s": lambda row: f"{1 / row['seconds']:.3g}",
    "goal": lambda row: row["goal"],
}


@dataclass(frozen=True)
class Effort:
    """How much to run; the models need not be good, only of the right size."""

    rounds: int
    fit_steps: int
    candidates: Sequence[int] = (100, 1000)
    n_steps: int = 200
    min_seconds: float = 0.0


EFFORT = {
    "quick": Effort(rounds=3, fit_steps=500),
    "full": Effort(rounds=15, fit_steps=1000, min_seconds=0.05),
}


def run(mode: str, effort: Effort) -> dict[str, Any]:
    """Fit the models once, then time decisions for each number of candidates."""
    with one_thread():
        planners = _Planners(effort.fit_steps, effort.n_steps)
        rows: list[Row] = []
        for n in effort.candidates:
            rows += measure(
                planners.cases(n),
                rounds=effort.rounds,
                min_seconds=effort.min_seconds,
                candidates=n,
            )
    return result(NAME, mode, rows, {"sizes": planners.sizes, "block": BLOCK, **asdict(effort)})


class _Planners:
    """Fitted models, and the decisions that they make among n candidates."""

    def __init__(self, fit_steps: int, n_steps: int) -> None:
        self.env = Cartpole()
        self.n_steps = n_steps
        episodes = self.env.collect(20, n_steps, random_state=0)
        learner = MLPEnsembleRegressor(
            hidden_layer_sizes=HIDDEN, batch_size=128, max_steps=fit_steps
        )
        self.trajectory = TrajectoryRegressor(learner, random_state=0).fit(episodes)
        self.one_step = OneStepRegressor(learner, policy=self.env.policy, random_state=0)
        self.one_step.fit(episodes)
        # a pole that can still be caught
        self.state = episodes[int(np.argmax(episodes.lengths))].states[0]
        d_s, p = episodes.states.shape[1], len(episodes.param_names)
        self.sizes = (d_s + 1 + p, *HIDDEN, d_s)

    def cases(self, n: int) -> list[Case]:
        """Everything that is timed for n candidates; the first is the bare products."""
        n_rows = n * self.n_steps
        goals = ("1.3x", "0.43x") if n == 1000 else ("", "")
        return [
            Case("bare GEMM", forward_products(self.sizes, n_rows, min(BLOCK, n_rows))),
            Case("T over policies", self._decision(self.trajectory, n), goal=goals[0]),
            Case(
                f"T over policies, every {EVERY}th step",
                self._decision(self.trajectory, n, every=EVERY),
                goal=goals[1],
            ),
            Case("T over policies, CEM", self._decision(self.trajectory, n, optimizer="cem")),
            Case("one-step over policies", self._decision(self.one_step, n)),
            Case(
                "one-step over actions",
                self._decision(self.one_step, n, decision="actions", bounds=self.env.action_bounds),
            ),
        ]

    def _decision(self, model: Any, n: int, **changes: Any) -> Callable[[], object]:
        """One decision from the same state, warm from the decision before."""
        settings = {
            "bounds": self.env.param_bounds,
            "reward": self.env.reward,
            "horizon": self.n_steps,
            "dt": self.env.dt,
            "n_candidates": n,
            "is_terminal": self.env.is_terminal,
            "terminal_reward": -10.0,
            "random_state": 0,
            **changes,
        }
        planner = MPC(model, **settings)
        return lambda: planner.plan(self.state)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    given = parser(NAME, __doc__ or "").parse_args(argv)
    mode = "quick" if given.quick else "full"
    finish(NAME, run(mode, EFFORT[mode]), COLUMNS, given.out)


if __name__ == "__main__":
    main()
