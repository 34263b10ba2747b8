"""What the errors of different formulations on the same episodes say of the data."""

import numpy as np
from numpy.typing import NDArray

from trajlearn.dynamics._members import unwrapped
from trajlearn.dynamics._rollouts.rolling import RollingEstimator
from trajlearn.dynamics._selection.report import Evidence, measurement_noise
from trajlearn.dynamics.lstm import LSTMRegressor
from trajlearn.dynamics.trajectory import TrajectoryRegressor

__all__ = ["diagnosis"]

Floats = NDArray[np.float64]

# how many times worse a kind of member is before anything is said about it
_MUCH = 3.0
# standard errors before a difference is called sure
_SURE = 2.0
# median squared error, in training ranges, beyond which a forecast says little: off by a tenth
_LOST = 0.01


def diagnosis(evidence: Evidence) -> str:
    """Sentences on noise, partial states, divergence and reach, each with its numbers."""
    return "\n".join(
        [_noise(evidence), _partial(evidence), _divergence(evidence), _reach(evidence)]
    )


def _noise(evidence: Evidence) -> str:
    found = {
        i: noise
        for i, model in enumerate(evidence.models)
        if (noise := measurement_noise(model)) is not None
    }
    if not found:
        return "Noise: no member looked for measurement noise (denoise='em')."
    ranking = evidence.ranking(1, evidence.errors.shape[2])
    best = min(found, key=ranking.index)
    name, noise = evidence.names[best], found[best]
    low, high = evidence.state_range
    if not noise.any():
        return f"Noise: {name}, the best of those that look for it, found no measurement noise."
    share = 100 * noise / np.where(high > low, high - low, 1.0)
    by_state = ", ".join(f"{s} {p:.2g} %" for s, p in zip(evidence.state_names, share))
    text = f"Noise: {name} found measurement noise, in percent of the training range: {by_state}."
    raw = [i for i in ranking if _sees(evidence, i) == "state" and i not in found]
    if not raw:
        return text
    return f"{text} {_compared(evidence, best, raw[0])}"


def _partial(evidence: Evidence) -> str:
    ranking = evidence.ranking(1, evidence.errors.shape[2])
    kinds = {i: _sees(evidence, i) for i in ranking}
    one = next((i for i in ranking if kinds[i] == "state"), None)
    other = next((i for i in ranking if kinds[i] == "more"), None)
    if one is None or other is None:
        return "Partial states: no comparison, which takes one-step members and others."
    every = slice(0, len(evidence.losses.knots))
    gain, unsure = evidence.losses.over(every, other, one)
    ratio = _ratio(evidence, one, other)
    if ratio > _MUCH and gain > _SURE * unsure:
        return (
            "Partial states: perhaps. Members that see one state at a time are far behind: "
            f"{_compared(evidence, other, one)} Something that matters may not be logged "
            "(velocities, a delay, the state of an actuator): try default_members(episodes, "
            "partial=True), or history= and latent_velocities=True of OneStepRegressor."
        )
    return (
        f"Partial states: no sign. {evidence.names[one]}, which sees one state at a time, has "
        f"{ratio:.2g} times the error of {evidence.names[other]}."
        if ratio < 1
        else f"Partial states: no clear sign. {_compared(evidence, other, one)}"
    )


def _divergence(evidence: Evidence) -> str:
    gone = np.isinf(evidence.errors).any(axis=2).sum(axis=1)
    if not gone.any():
        return "Divergence: none of the held-out forecasts diverged."
    judged = evidence.n_judged
    told = ", ".join(f"{evidence.names[i]} {gone[i]} of {judged[i]}" for i in np.flatnonzero(gone))
    return f"Divergence: of the held-out forecasts, so many diverged: {told}."


def _reach(evidence: Evidence) -> str:
    n_steps = evidence.errors.shape[2]
    winner = evidence.weights.argmax(axis=1)
    chosen = evidence.errors[winner, :, np.arange(n_steps)]
    lost = np.flatnonzero(_medians(chosen) > _LOST)
    if not len(lost):
        return (
            f"Reach: to the last step, {n_steps}, the median forecast is off by less than a tenth "
            "of the training range."
        )
    return (
        f"Reach: from step {lost[0] + 1} of {n_steps} on, the median forecast is off by more than "
        "a tenth of the training range."
    )


def _sees(evidence: Evidence, i: int) -> str:
    """What a member sees of the past: the "state", "more", or it is not known."""
    model = unwrapped(evidence.models[i])
    if isinstance(model, TrajectoryRegressor):
        # it need not go through the states between
        return "more"
    if not isinstance(model, RollingEstimator) or "action" not in getattr(model, "layout_", ()):
        return "unknown"
    latent = getattr(model, "latent_velocities", False)
    remembers = isinstance(model, LSTMRegressor) or model._history() > 1
    return "more" if latent or remembers else "state"


def _ratio(evidence: Evidence, one: int, other: int) -> float:
    """Error of a member in units of another's."""
    n_steps = evidence.errors.shape[2]
    pair = (one, other), (other, one)
    errors = [max(evidence.error(i, 1, n_steps, beside), 1e-300) for i, beside in pair]
    return errors[0] / errors[1]


def _compared(evidence: Evidence, one: int, other: int) -> str:
    """How far the other member is behind, or ahead, and how surely."""
    every = slice(0, len(evidence.losses.knots))
    gain, unsure = evidence.losses.over(every, one, other)
    apart = "is the same"
    if gain:
        sure = f"by {abs(gain) / unsure:.1f} standard errors" if unsure > 0 else "in every episode"
        apart = f"is {'greater' if gain > 0 else 'less'} {sure}"
    return (
        f"{evidence.names[other]} has {_ratio(evidence, other, one):.3g} times the error of "
        f"{evidence.names[one]} (its loss {apart})."
    )


def _medians(values: Floats) -> Floats:
    """Median over episodes at each step (H, n) without NaN; some episode reaches each."""
    return np.array([np.median(row[~np.isnan(row)]) for row in values])
