"""One planning decision of MPC on cartpole: candidates x 200 steps, with T and one-step models.

Ratios are to the products of T's network over all candidates and steps, one member, in blocks
that stay in cache, whatever the case computes. What MPC adds to a prediction is candidates,
rewards, ends of trajectories and the choice.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.speed._candidates import (
    EVERY,
    HIDDEN,
    Effort,
    bare_products,
    columns,
    learner,
    run_candidates,
)
from benchmarks.speed._command import command_line
from benchmarks.speed._timing import Case
from trajlearn import Cartpole, OneStepRegressor, TrajectoryRegressor
from trajlearn.control import MPC

NAME = "plan"
COLUMNS = columns("decisions/s", lambda row: f"{1 / row['seconds']:.3g}")
CANDIDATES = (100, 1000)
EFFORT = {
    "quick": Effort(rounds=3, fit_steps=500, candidates=CANDIDATES),
    "full": Effort(rounds=15, fit_steps=1000, candidates=CANDIDATES, min_seconds=0.05),
}


def run(mode: str, effort: Effort) -> dict[str, Any]:
    """Fit the models once, then time decisions for each number of candidates."""
    return run_candidates(NAME, mode, effort, _Planners)


class _Planners:
    """Fitted models, and the decisions that they make among n candidates."""

    def __init__(self, fit_steps: int, n_steps: int) -> None:
        self.env = Cartpole()
        self.n_steps = n_steps
        episodes = self.env.collect(20, n_steps, random_state=0)
        network = learner(fit_steps)
        self.trajectory = TrajectoryRegressor(network, random_state=0).fit(episodes)
        self.one_step = OneStepRegressor(network, policy=self.env.policy, random_state=0)
        self.one_step.fit(episodes)
        # a pole that can still be caught
        self.state = episodes[int(np.argmax(episodes.lengths))].states[0]
        d_s, p = episodes.states.shape[1], len(episodes.param_names)
        self.sizes = (d_s + 1 + p, *HIDDEN, d_s)

    def cases(self, n: int) -> list[Case]:
        """Everything that is timed for n candidates; the first is the bare products."""
        goals = ("1.3x", "0.43x") if n == 1000 else ("", "")
        return [
            Case("bare GEMM", bare_products(self.sizes, n * self.n_steps)),
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
    command_line(NAME, __doc__ or "", run, EFFORT, COLUMNS, argv)


if __name__ == "__main__":
    main()
