"""Candidates x 200 horizons of cartpole: T through its public door and below, one-step roll-outs.

"Predictor" is what is left of T without checks and scaling: on ready rows, or on the product of
starts and horizons, which computes the first layer once for each. Ratios are to the products of
T's network over all rows, one member, in blocks that stay in cache, whatever the case computes.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.neural_network import MLPRegressor

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
from trajlearn import Cartpole, OneStepRegressor, TrajectoryDataset, TrajectoryRegressor

NAME = "predict"
COLUMNS = columns("trajectories/s", lambda row: f"{row['candidates'] / row['seconds']:,.0f}")
EFFORT = {
    "quick": Effort(rounds=3, fit_steps=500),
    "full": Effort(rounds=15, fit_steps=1000, min_seconds=0.05),
}

Floats = NDArray[np.float64]


def run(mode: str, effort: Effort) -> dict[str, Any]:
    """Fit every model once, then time them for each number of candidates."""
    return run_candidates(NAME, mode, effort, _Models)


class _Models:
    """Fitted models, and the cases that they make for n candidates."""

    def __init__(self, fit_steps: int, n_steps: int) -> None:
        self.env = Cartpole()
        self.n_steps = n_steps
        episodes = self.env.collect(20, n_steps, random_state=0)
        self.episodes = episodes
        self.trajectory = TrajectoryRegressor(learner(fit_steps), random_state=0).fit(episodes)
        self.one_step = {
            n_members: OneStepRegressor(
                learner(fit_steps, n_members), policy=self.env.policy, random_state=0
            ).fit(episodes)
            for n_members in (1, 5)
        }
        rows = self._rows(*_starts(episodes, 10)).astype(np.float32)
        targets = rows[:, : episodes.states.shape[1]]
        # as many outputs as states; what they mean costs nothing
        self.scikit_learn = MLPRegressor(hidden_layer_sizes=HIDDEN, random_state=0).partial_fit(
            rows, targets
        )
        self.sizes = (rows.shape[1], *HIDDEN, targets.shape[1])
        a, b, c, d = self.sizes
        self.naive = torch.nn.Sequential(
            torch.nn.Linear(a, b),
            torch.nn.ReLU(),
            torch.nn.Linear(b, c),
            torch.nn.ReLU(),
            torch.nn.Linear(c, d),
        )

    def cases(self, n: int) -> list[Case]:
        """Everything that is timed for n candidates; the first is the bare products."""
        states, params = _starts(self.episodes, n)
        horizons = self.env.dt * np.arange(1, self.n_steps + 1)
        model, predictor = self.trajectory, self.trajectory.estimator_.predictor()
        rows = self._rows(states, params)
        single = torch.from_numpy(rows.astype(np.float32))
        goal = "1.3x" if n == 1000 else ""

        def forecast(model: Any, horizons: Floats) -> Callable[[], object]:
            return lambda: model.predict_trajectory(states, params=params, horizons=horizons)

        def naive() -> torch.Tensor:
            with torch.no_grad():
                return self.naive(single)

        return [
            Case("bare GEMM", bare_products(self.sizes, len(rows))),
            Case("T, predict_trajectory", forecast(model, horizons), goal=goal),
            Case(f"T, every {EVERY}th horizon", forecast(model, horizons[EVERY - 1 :: EVERY])),
            Case("T, Predictor on the product", self._product(states, params), goal=goal),
            Case("T, Predictor on rows", lambda: predictor(rows)),
            Case("one-step roll-out with policy", forecast(self.one_step[1], horizons)),
            Case("one-step roll-out, 5 members", forecast(self.one_step[5], horizons)),
            Case("scikit-learn MLPRegressor", lambda: self.scikit_learn.predict(single.numpy())),
            Case("torch, all rows at once", naive),
        ]

    def _rows(self, states: Floats, params: Floats) -> Floats:
        """Scaled rows of all candidates at all horizons."""
        n, steps = len(states), np.arange(1, self.n_steps + 1)
        horizons = self.env.dt * np.tile(steps, n)[:, None]
        raw = np.hstack([states.repeat(len(steps), 0), horizons, params.repeat(len(steps), 0)])
        return self.trajectory.scaler_.transform(raw)

    def _product(self, states: Floats, params: Floats) -> Callable[[], object]:
        """The same rows as starts times horizons."""
        rows = self._rows(states, params).reshape(len(states), self.n_steps, -1)
        horizon = self.trajectory.scaler_.block_columns_["horizon"]
        rest = np.setdiff1d(np.arange(rows.shape[2]), horizon)
        product = self.trajectory.estimator_.predictor().product
        left, right = rows[:, 0, rest], rows[0][:, horizon]
        index = (
            np.arange(len(left)).repeat(len(right)),
            np.tile(np.arange(len(right)), len(left)),
        )
        return lambda: product(left, right, (rest, horizon), index)


def _starts(episodes: TrajectoryDataset, n: int) -> tuple[Floats, Floats]:
    """Initial states and gains of n candidates, taken from the episodes in turn."""
    episode = np.arange(n) % len(episodes)
    params = episodes.params
    if params is None:
        raise ValueError("the episodes need params.")
    return episodes.states[episodes.offsets[:-1][episode]], params[episode]


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    command_line(NAME, __doc__ or "", run, EFFORT, COLUMNS, argv)


if __name__ == "__main__":
    main()
