"""Mirror images of episodes: motions that the simulators make just as well.

Cartpole under linear feedback is odd in the state. The reacher, without gravity, may be mirrored
at the plane x = 0, which turns the hinges about z the other way round (a rotation about the
normal of the mirror keeps its sense), at the plane z = 0, and at both. All images are exact.
"""

from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trajlearn import TrajectoryDataset
from trajlearn.envs.reacher import JOINTS


class Image(NamedTuple):
    """Signs of the states (d_s,), actions (d_a,) and params (p,) of an episode's image."""

    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    params: NDArray[np.float64]


def _of_cartpole(sign: float) -> Image:
    return Image(np.full(4, sign), np.full(1, sign), np.ones(4))


def _of_reacher(about_z: float, about_x: float) -> Image:
    joints = np.array([about_z if joint.endswith("z") else about_x for joint in JOINTS])
    same = np.ones(len(JOINTS))
    # cosines, sines, velocities; gains and targets
    return Image(np.r_[same, joints, joints], joints, np.r_[same, same, joints])


#: The images that a task has, the episode itself first.
IMAGES = {
    "cartpole": [_of_cartpole(sign) for sign in (1.0, -1.0)],
    "reacher": [_of_reacher(*signs) for signs in product((1.0, -1.0), repeat=2)],
}


def mirrored(task: str, ds: TrajectoryDataset) -> TrajectoryDataset:
    """The episodes and all their images."""
    first, *others = (_imaged(ds, [image] * len(ds)) for image in IMAGES[task])
    return first.concatenate(*others)


def folded(ds: TrajectoryDataset) -> TrajectoryDataset:
    """Each episode of cartpole or its image, whichever begins with the pole to the right.

    For direct reward models. Both images together would mislead a Gaussian process: they share
    theta and reward, so that noise-free interpolation over theta alone explains the data best.
    """
    return _imaged(ds, [IMAGES["cartpole"][int(episode.states[0, 2] < 0)] for episode in ds])


def _imaged(ds: TrajectoryDataset, images: Iterable[Image]) -> TrajectoryDataset:
    """Image of every episode, without its rewards."""
    pairs = list(zip(images, ds, strict=True))
    return TrajectoryDataset.from_arrays(
        [image.states * episode.states for image, episode in pairs],
        actions=[image.actions * episode.actions for image, episode in pairs],
        params=[image.params * episode.params for image, episode in pairs],
        times=[episode.times for episode in ds],
        **ds.names,
    )
