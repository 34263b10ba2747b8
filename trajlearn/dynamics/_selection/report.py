"""Tables of what a selection is based on."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._members import unwrapped
from trajlearn.dynamics._selection.losses import HorizonLosses

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Evidence", "by_horizon", "by_member", "errors_by_horizon", "measurement_noise"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Evidence:
    """What held-out episodes say of M members, and what was chosen.

    Attributes
    ----------
    names : tuple of str
    models : list of estimator
        Fitted on all episodes.
    errors : ndarray of shape (M, n, H)
        Squared, in training ranges; NaN where there is nothing to compare, inf from a divergence.
    losses : HorizonLosses
    weights : ndarray of shape (H, M)
    state_names : tuple of str
    state_range : ndarray of shape (2, d_s)
    fit_seconds, predict_seconds : dict from name to float
    """

    names: tuple[str, ...]
    models: list[Any]
    errors: Floats
    losses: HorizonLosses
    weights: Floats
    state_names: tuple[str, ...]
    state_range: Floats
    fit_seconds: dict[str, float]
    predict_seconds: dict[str, float]

    @property
    def n_judged(self) -> Ints:
        """Episodes that each member was judged by (M,)."""
        return (~np.isnan(self.errors).all(axis=2)).sum(axis=1)

    @property
    def blocks(self) -> list[tuple[int, int, int]]:
        """Winner, first and last step (from 1) of each block of steps with the same winner."""
        winner = self.weights.argmax(axis=1)
        begins = np.flatnonzero(np.diff(winner, prepend=-1))
        ends = np.append(begins[1:], len(winner))
        return [(int(winner[a]), int(a) + 1, int(b)) for a, b in zip(begins, ends)]

    def error(self, member: int, first: int, last: int, beside: int | None = None) -> float:
        """Median over episodes of the squared error, averaged over the steps from 1.

        Beside another member, only what that one was judged by as well counts.
        """
        some = self.errors[member, :, first - 1 : last]
        known = ~np.isnan(some)
        if beside is not None:
            known &= ~np.isnan(self.errors[beside, :, first - 1 : last])
        reached = known.any(axis=1)
        if not reached.any():
            return np.nan
        total = np.where(known, some, 0.0)[reached].sum(axis=1)
        return float(np.median(total / known[reached].sum(axis=1)))

    def knots(self, first: int, last: int) -> slice:
        """The knots of the losses that lie in a block, or the nearest one."""
        at = np.searchsorted(self.losses.knots, [first, last + 1])
        return slice(min(int(at[0]), len(self.losses.knots) - 1), max(int(at[1]), int(at[0]) + 1))

    def ranking(self, first: int, last: int) -> list[int]:
        """Members by their mean loss over a block of steps, the best first."""
        return self.losses.ranking(self.knots(first, last))


def errors_by_horizon(evidence: Evidence) -> "pd.DataFrame":
    """One row a member and step."""
    import pandas as pd

    n_members, _, n_steps = evidence.errors.shape
    absent = np.isnan(evidence.errors)
    count = (~absent).sum(axis=1)
    # a step without any is filled, and left out below
    some = np.where(absent.all(axis=1, keepdims=True), 0.0, evidence.errors)
    losses = [
        np.interp(np.log(np.arange(1, n_steps + 1)), np.log(evidence.losses.knots), loss)
        for loss in evidence.losses.averages
    ]
    columns = {
        "median": np.nanmedian(some, axis=1),
        "mean": np.nanmean(some, axis=1),
        "loss": np.stack(losses),
    }
    return pd.DataFrame(
        {
            "member": np.repeat(evidence.names, n_steps),
            "horizon": np.tile(np.arange(1, n_steps + 1), n_members),
            "n_episodes": count.ravel(),
            "n_diverged": np.isinf(evidence.errors).sum(axis=1).ravel(),
            **{name: np.where(count == 0, np.nan, v).ravel() for name, v in columns.items()},
        }
    )


def by_horizon(evidence: Evidence) -> "pd.DataFrame":
    """One row a block of steps with the same winner."""
    import pandas as pd

    rows = []
    for winner, first, last in evidence.blocks:
        error = evidence.error(winner, first, last)
        row: dict[str, Any] = {"from": first, "to": last, "winner": evidence.names[winner]}
        row |= {"error": error, "second": None, "ratio": np.nan, "standard_errors": np.nan}
        others = [i for i in evidence.ranking(first, last) if i != winner]
        if others:
            second = others[0]
            gain, unsure = evidence.losses.over(evidence.knots(first, last), winner, second)
            missed = evidence.error(second, first, last)
            beside = evidence.error(winner, first, last, second)
            row["second"] = evidence.names[second]
            row["ratio"] = missed / beside if beside else np.nan
            sure = np.inf if gain > 0 else -np.inf if gain < 0 else 0.0
            row["standard_errors"] = gain / unsure if unsure else sure
        rows.append(row)
    return pd.DataFrame(rows)


def by_member(evidence: Evidence) -> "pd.DataFrame":
    """One row a member, the best first."""
    import pandas as pd

    n_steps = evidence.errors.shape[2]
    winner = evidence.weights.argmax(axis=1)
    low, high = evidence.state_range
    width = np.where(high > low, high - low, 1.0)
    averages = evidence.losses.averages
    steps = evidence.losses.width * ~np.isnan(averages)
    loss = (np.nan_to_num(averages) * steps).sum(axis=1) / steps.sum(axis=1)
    rows = []
    for i in evidence.ranking(1, n_steps):
        name, noise = evidence.names[i], measurement_noise(evidence.models[i])
        rows.append(
            {
                "member": name,
                "steps": int((winner == i).sum()),
                "n_episodes": int(evidence.n_judged[i]),
                "error": evidence.error(i, 1, n_steps),
                "loss": loss[i],
                "n_diverged": int(np.isinf(evidence.errors[i]).any(axis=1).sum()),
                "fit_seconds": evidence.fit_seconds[name],
                "predict_seconds": evidence.predict_seconds[name],
                "measurement_noise": np.nan if noise is None else 100 * np.mean(noise / width),
            }
        )
    return pd.DataFrame(rows).set_index("member")


def measurement_noise(model: Any) -> Floats | None:
    """Standard deviation by state that a smoothing model found; None of those that do not look."""
    model = unwrapped(model)
    if not hasattr(model, "noisy_"):
        return None
    found = np.asarray(model.measurement_noise_, dtype=np.float64)
    return found if model.noisy_ else np.zeros_like(found)
