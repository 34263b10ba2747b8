"""What a planner decides, and where it is."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Plan", "Session"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """One decision of a planner.

    Attributes
    ----------
    params : ndarray of shape (p,) or None
        Control parameters, where they are what is decided.
    actions : ndarray of shape (horizon, d_a) or None
        Actions from now on, where they are what is decided.
    value : float
        What was maximised: the predicted return over the planned horizon, or its lower
        confidence bound.
    violation : float or None
        Share of predicted trajectories that break the constraint, if there is one.
    seconds : float
        Wall-clock time that the decision took.
    n_candidates : int
        Candidates that were assessed.
    """

    params: Floats | None
    actions: Floats | None
    value: float
    violation: float | None
    seconds: float
    n_candidates: int


@dataclass
class Session:
    """Decisions so far, and where the trial is.

    `dt` and `policy` are those of the environment in which it runs, None elsewhere.
    """

    dt: float | None = None
    policy: Any = None
    trial: int = 0
    step: int = 0
    # steps for which the current plan has been followed
    held: int = 0
    plan: Plan | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)

    def next_trial(self) -> None:
        """Forget the plan; a trial in which nothing happened does not count."""
        if self.plan is not None:
            self.trial += 1
        self.step, self.held, self.plan = 0, 0, None

    def decided(self, plan: Plan) -> None:
        """Follow another plan from here on."""
        self.plan, self.held = plan, 0
        self.rows.append(
            {
                "trial": self.trial,
                "step": self.step,
                "seconds": plan.seconds,
                "value": plan.value,
            }
        )

    def acted(self) -> None:
        """One more step under the current plan."""
        self.step += 1
        self.held += 1

    def table(self) -> "pd.DataFrame":
        """One row a decision."""
        import pandas as pd

        return pd.DataFrame(self.rows, columns=["trial", "step", "seconds", "value"])
