"""Mirror images are motions of the same system."""

import numpy as np
import pytest

from benchmarks.paper._symmetry import IMAGES, folded, mirrored
from benchmarks.paper._tasks import environment

TASKS = ["cartpole", "reacher"]


@pytest.fixture(scope="module", params=TASKS)
def task(request):
    return request.param


@pytest.fixture(scope="module")
def flown(task):
    return environment(task).collect(3, 40, random_state=0)


def test_images_obey_the_same_dynamics_and_controller(task, flown):
    every = mirrored(task, flown)
    assert len(every) == len(IMAGES[task]) * len(flown)
    starts = np.array([episode.states[0] for episode in every])
    again = environment(task).rollout(starts, np.array([e.params for e in every]), 40)
    for one, other in zip(every, again, strict=True):
        np.testing.assert_allclose(one.states, other.states, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.actions, other.actions, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(one.times, other.times)


def test_the_images_differ_and_the_episode_comes_first(task, flown):
    every = mirrored(task, flown)
    for i, episode in enumerate(flown):
        np.testing.assert_array_equal(every[i].states, episode.states)
    last = [every[i].states[-1] for i in range(0, len(every), len(flown))]
    assert len(np.unique(last, axis=0)) == len(IMAGES[task])


def test_the_reachers_images_are_mirrored_in_space():
    env = environment("reacher")
    flown = env.collect(1, 30, random_state=0)
    tips = [env.fingertip(episode.states) for episode in mirrored("reacher", flown)]
    for tip, signs in zip(tips, [(1, 1, 1), (1, 1, -1), (-1, 1, 1), (-1, 1, -1)], strict=True):
        np.testing.assert_allclose(tip, tips[0] * signs, atol=1e-12)
    assert np.ptp([env.reward(episode.states).mean() for episode in mirrored("reacher", flown)]) > 0


def test_folding_keeps_rewards_and_forgets_the_side():
    env = environment("cartpole")
    flown = env.collect(6, 20, random_state=1)
    once, other = folded(flown), folded(mirrored("cartpole", flown))
    tilts = [episode.states[0, 2] for episode in flown]
    assert min(tilts) < 0 < max(tilts)
    assert all(episode.states[0, 2] >= 0 for episode in once)
    np.testing.assert_array_equal(other.states[: len(once.states)], once.states)
    np.testing.assert_array_equal(other.states[len(once.states) :], once.states)
    for episode, image in zip(flown, once, strict=True):
        np.testing.assert_allclose(env.reward(image.states), env.reward(episode.states))
