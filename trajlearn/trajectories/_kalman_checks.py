"""Where smoothing cannot help: filtered states, motion unlike the model, wrapped angles."""

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import SmoothingWarning
from trajlearn.trajectories._kalman_fit import Signals

__all__ = [
    "contradiction",
    "warn_contradicting",
    "warn_correlated",
    "warn_filtered",
    "warn_misfit",
    "warn_wrapped",
]

Floats = NDArray[np.float64]

# Noise below this share of the change between samples: nothing that a filter could remove.
_FILTERED = 0.05
# A smoother that moves states by more than so much of their noise removes motion, not noise.
_MISFIT = 1.2
# Correlation of innovations that is of material size: over one sample, and summed over the next
# three where it is negative. And how many standard errors it has to be at least.
_NEXT, _LATER, _ERRORS = 0.3, -0.25, 4.0
# By how much noise may widen the values of a wrapped angle.
_WIDER = 1.0
# Steps over which a change of position is compared with the integral of the velocity.
_STEPS = 20
# Share of the change of position that may be missing in that integral for reasons of sampling.
_TOLERANCE = 0.05


def warn_filtered(names: Sequence[str], noise: Floats, change: Floats) -> list[str]:
    """Warn of states whose estimated noise is far below their change between samples.

    Parameters
    ----------
    names : sequence of d names
    noise, change : ndarray of shape (d,)
        Standard deviation of the measurement noise; root mean square change between samples.

    Returns
    -------
    list of str
        Their names.
    """
    low = {
        name: f"{name} ({sigma:.2g} against {step:.2g})"
        for name, sigma, step in zip(names, noise, change, strict=True)
        if sigma < _FILTERED * step
    }
    if low:
        warnings.warn(
            f"the estimated measurement noise is far below the change between samples in "
            f"{', '.join(low.values())}: these states are noise-free or outputs of a filter, and "
            "smoothing hardly helps and can harm. Leave them out (states=), or the smoother.",
            SmoothingWarning,
            stacklevel=5,
        )
    return list(low)


def warn_misfit(names: Sequence[str], moved: Floats, noise: Floats) -> list[str]:
    """Warn of states that smoothing moves further than their noise.

    Parameters
    ----------
    names : sequence of d names
    moved, noise : ndarray of shape (d,)
        Root mean square, and standard deviation.

    Returns
    -------
    list of str
        Their names.
    """
    off = {
        name: f"{name} by {far:.2g} (noise {sigma:.2g})"
        for name, far, sigma in zip(names, moved, noise, strict=True)
        if far > _MISFIT * sigma
    }
    if off:
        warnings.warn(
            f"smoothing moves {', '.join(off.values())}: more than noise explains, so the model "
            "of motion does not fit (jumps, fast transients, too slow sampling). Leave these "
            "states out (states=), try another model, or give process_noise.",
            SmoothingWarning,
            stacklevel=5,
        )
    return list(off)


def warn_correlated(found: dict[str, tuple[float, float, int]]) -> None:
    """Warn of states whose innovations are correlated: the model of motion is another one.

    Parameters
    ----------
    found : mapping from name to numbers
        As of `correlations`: over one sample, over the next three, from how many.
    """
    off = []
    for name, (following, later, n) in found.items():
        error = _ERRORS / np.sqrt(max(n, 1))
        if abs(following) > max(_NEXT, error) or later < min(_LATER, -error * np.sqrt(3)):
            off.append(
                f"{name} ({following:.2f} over one sample, {later:.2f} in all over two to four)"
            )
    if off:
        warnings.warn(
            f"the model of motion does not fit: innovations are correlated in {', '.join(off)}. "
            "What it takes for noise is motion, or was filtered already, and smoothing may harm: "
            "compare with and without, or leave these states out (states=).",
            SmoothingWarning,
            stacklevel=5,
        )


def warn_wrapped(names: Sequence[str], states: Floats, steps: Floats) -> list[str]:
    """Warn of states that look like angles which jump by 2 pi.

    Parameters
    ----------
    names : sequence of d names
    states, steps : ndarray of shape (rows, d) and (some, d)
        Values, and changes from sample to sample.

    Returns
    -------
    list of str
        Their names.
    """
    size = np.abs(steps)
    jumps = (size > 1.5 * np.pi).sum(axis=0)
    # of motion or noise that is so wide, most changes are less than its whole width
    between = (size > 0.5 * np.pi).sum(axis=0) - jumps
    wraps = (jumps > between) & (np.ptp(states, axis=0) < 2 * np.pi + _WIDER)
    off = [name for name, is_angle in zip(names, wraps, strict=True) if is_angle]
    if off:
        warnings.warn(
            f"{', '.join(off)}: jumps of about 2 pi between samples, as of an angle that wraps. "
            "Unwrap first (numpy.unwrap), or leave out (states=).",
            SmoothingWarning,
            stacklevel=5,
        )
    return off


def contradiction(signals: Signals) -> float | None:
    """How far a velocity is from the derivative of a position, or None if not beyond the noise.

    The change of position over some steps is compared with the integral of the velocity. What
    the noise of both and the sampling explain (an integral from samples is off by up to half a
    step's change of velocity) is no contradiction.

    Parameters
    ----------
    signals : Signals
        Position and velocity.

    Returns
    -------
    float or None
        Root mean square difference in root mean square changes of position.
    """
    position, velocity = signals.measured[:, 0, :, 0], signals.measured[:, 0, :, 1]
    dt, noise = signals.grid.dt, signals.roughness()
    if np.isnan(noise).any():
        return None
    start = np.zeros((1, dt.shape[1]))
    times = np.concatenate([start, np.cumsum(dt, axis=0)])
    travelled = np.cumsum(dt * (velocity[1:] + velocity[:-1]) / 2, axis=0)
    travelled = np.concatenate([start, travelled])
    k = min(_STEPS, int(signals.grid.known.sum(axis=0).max()) - 1)
    use = signals.grid.known[k:]
    moved = (position[k:] - position[:-k])[use]
    gap = moved - (travelled[k:] - travelled[:-k])[use]
    step = (times[k:] - times[:-k])[use] / k
    turned = (velocity[k:] - velocity[:-k])[use] * step / 2
    explained = 2 * noise[0] + k * step**2 * noise[1] + turned**2
    motion = float(np.mean(moved**2))
    if float(np.mean(gap**2)) <= 2 * float(np.mean(explained)) + _TOLERANCE**2 * motion:
        return None
    return float(np.sqrt(np.mean(gap**2) / max(motion, np.finfo(np.float64).tiny)))


def warn_contradicting(gaps: dict[tuple[str, str], float]) -> None:
    """Warn of pairs of position and velocity that no motion could have."""
    if not gaps:
        return
    listed = ", ".join(f"{v} and d{x}/dt ({100 * gap:.0f} %)" for (x, v), gap in gaps.items())
    warnings.warn(
        f"velocities contradict their positions beyond noise and sampling: {listed} differ over "
        f"{_STEPS} samples, in per cent of the movement. One filter for both would move the "
        "positions by as much: check units and frames, or leave the pair out of velocities=.",
        SmoothingWarning,
        stacklevel=5,
    )
