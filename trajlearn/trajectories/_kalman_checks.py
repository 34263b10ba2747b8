"""Where smoothing cannot help: states that were filtered already, velocities that contradict."""

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trajlearn.exceptions import SmoothingWarning
from trajlearn.trajectories._kalman_fit import Signals

__all__ = ["contradiction", "warn_contradicting", "warn_filtered", "warn_misfit"]

Floats = NDArray[np.float64]

# Noise below this share of the change between samples: nothing that a filter could remove.
_FILTERED = 0.05
# A smoother that moves states by more than so much of their noise removes motion, not noise.
_MISFIT = 1.2
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


def warn_misfit(names: Sequence[str], moved: Floats, noise: Floats) -> None:
    """Warn of states that smoothing moves further than their noise.

    Parameters
    ----------
    names : sequence of d names
    moved, noise : ndarray of shape (d,)
        Root mean square, and standard deviation.
    """
    off = [
        f"{name} by {far:.2g} (noise {sigma:.2g})"
        for name, far, sigma in zip(names, moved, noise, strict=True)
        if far > _MISFIT * sigma
    ]
    if off:
        warnings.warn(
            f"smoothing moves {', '.join(off)}: more than noise explains, so the model of motion "
            "does not fit (jumps, fast transients, too slow sampling). Leave these states out "
            "(states=), try another model, or give process_noise.",
            SmoothingWarning,
            stacklevel=5,
        )


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
