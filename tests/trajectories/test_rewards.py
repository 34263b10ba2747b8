"""Rewards by step and by episode."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn.exceptions import MissingFieldError
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories.rewards import episode_rewards, step_rewards


def episodes(lengths=(3, 5, 2), terminated=(True, False, True), **fields):
    states = [10.0 * i + np.arange(t + 1.0)[:, None] for i, t in enumerate(lengths)]
    return TrajectoryDataset.from_arrays(states, terminated=terminated, **fields)


def value(states):
    return states[..., 0]


def test_a_reward_belongs_to_the_state_its_step_leads_into():
    ds = episodes((4,), (False,))
    assert episode_rewards(ds, value) == [np.mean([1, 2, 3, 4])]


def test_signals_are_those_of_the_step():
    ds = TrajectoryDataset.from_arrays(
        [[[0.0], [1.0], [2.0]]],
        actions=[[[10.0], [20.0]]],
        references=[[[100.0], [200.0], [300.0]]],
        times=[[0.0, 0.5, 2.0]],
    )
    seen = {}

    def reward(states, times, actions, references, weight=2.0):
        seen.update(times=times, actions=actions, references=references)
        return weight * states[..., 0]

    assert episode_rewards(ds, reward) == [3.0]
    assert seen["times"].tolist() == [0.5, 2.0]
    assert seen["actions"].tolist() == [[10.0], [20.0]]
    assert seen["references"].tolist() == [[200.0], [300.0]]


def test_logged_rewards_are_used_where_no_function_is_given():
    ds = episodes((3, 3), (False, False), rewards=[[1.0, 2, 3], [4, 5, 9]])
    np.testing.assert_allclose(episode_rewards(ds), [2.0, 6.0])
    np.testing.assert_allclose(episode_rewards(ds, start=1, horizon=1), [2.0, 5.0])
    with pytest.raises(MissingFieldError, match="rewards"):
        episode_rewards(episodes())


def test_missing_steps_after_a_termination_are_worth_what_is_said():
    ds = episodes()
    found = episode_rewards(ds, value, terminal_reward=-7.0)
    np.testing.assert_allclose(found, [(6 - 14) / 5, 65 / 5, (43 - 21) / 5])
    np.testing.assert_allclose(episode_rewards(ds, value, horizon=2), [1.5, 11.5, 21.5])
    late = episode_rewards(ds[:2], value, start=2, terminal_reward=0.0)
    np.testing.assert_allclose(late, [1.0, 14.0])


def test_a_crash_never_pays():
    # all rewards are negative: without a terminal reward, ending early would be best
    states = [np.ones((t + 1, 1)) for t in (10, 2)]
    ds = TrajectoryDataset.from_arrays(states, terminated=[False, True])
    full, crashed = episode_rewards(ds, lambda states: -states[..., 0], terminal_reward=-5.0)
    assert crashed < full


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": 5}, "episode 0 terminated 2 steps before the horizon: give terminal_reward="),
        ({"horizon": 6, "terminal_reward": 0.0}, "episode 1 has 5 steps, 1 fewer"),
        ({"start": 5}, "leaves no step"),
        ({"horizon": 0}, "below 1"),
        ({"reward": lambda states: states}, r"shape \(3, 1\)"),
        ({"reward": lambda states: 1.0}, r"shape \(\)"),
        ({"reward": lambda states: np.nan * states[..., 0]}, "NaN"),
        ({"reward": lambda states, actions: states}, r"\['actions'\]"),
    ],
)
def test_what_is_wrong_is_named(settings, message):
    with pytest.raises(ValueError, match=message):
        episode_rewards(episodes(), **{"reward": value} | settings)


def test_a_reward_of_predicted_states_may_be_non_finite_where_they_are():
    states = np.array([[1.0], [np.inf], [np.nan]])
    found = step_rewards(lambda s: -(s[..., 0] ** 2), states)
    np.testing.assert_array_equal(found, [-1.0, -np.inf, np.nan])


@given(
    shape=st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 5)),
    width=st.integers(1, 3),
)
def test_rewards_have_the_shape_of_the_states_without_the_last_axis(shape, width):
    states = np.random.default_rng(0).normal(size=(*shape, width))
    assert step_rewards(lambda s: s.sum(axis=-1), states).shape == shape
