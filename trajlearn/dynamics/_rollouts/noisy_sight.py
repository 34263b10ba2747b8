"""A controller that acts on noisy measurements: what it sees in a roll-out has noise, too.

The noise does not average out: through the saturation, and through a plant that is not linear,
the mean of many noisy roll-outs is another than a roll-out without noise.
"""

from collections.abc import Callable, Mapping

import numpy as np

from trajlearn.dynamics._rollouts.cloned_policy import Controller
from trajlearn.dynamics._rollouts.rollout import Floats

__all__ = ["Normal", "independent", "noisy_sight", "paired"]

# standard normal numbers of a shape (m, d_s)
Normal = Callable[[tuple[int, ...]], Floats]


def noisy_sight(control: Controller, std: Floats, normal: Normal) -> Controller:
    """The controller, seeing states with noise of standard deviation `std` (d_s,)."""

    def see(states: Floats, k: int, past: Mapping[str, Floats]) -> Floats:
        actions: Floats = control(states + std * normal(states.shape), k, past)
        return actions

    return see


def independent(rng: np.random.Generator) -> Normal:
    """Every particle of every start has noise of its own."""
    return lambda shape: rng.standard_normal(shape)


def paired(n: int, seed: int) -> Normal:
    """Half of the particles have the opposite noise of the others, at all n starts the same.

    A mean over them is the same bits each time and whatever the other starts are, and noise that
    enters linearly leaves it as it is.
    """
    rng = np.random.default_rng(seed)

    def draw(shape: tuple[int, ...]) -> Floats:
        copies = shape[0] // n
        half = rng.standard_normal((-(-copies // 2), shape[1]))
        return np.repeat(np.concatenate([half, -half])[:copies], n, axis=0)

    return draw
