"""One episode: what is accepted, what is refused, and that it never changes."""

import copy
import pickle

import numpy as np
import pytest

from trajlearn.exceptions import InvalidEpisodeError
from trajlearn.trajectories import Trajectory

STATES = np.arange(8.0).reshape(4, 2)


def full():
    return Trajectory(
        STATES,
        actions=np.ones((3, 1)),
        rewards=[0.0, 1.0, 2.0],
        params=[0.5],
        references=np.zeros((4, 1)),
        times=[0.0, 0.1, 0.3, 0.4],
        time_origin=-0.05,
        context={"task": "reach", "load": 2},
        group="lab",
        terminated=True,
        id="run 7",
    )


def test_fields_keep_what_was_given():
    episode = full()
    assert len(episode) == episode.length == 3
    np.testing.assert_array_equal(episode.states, STATES)
    np.testing.assert_array_equal(episode.times, [0.0, 0.1, 0.3, 0.4])
    assert (episode.group, episode.id, episode.terminated) == ("lab", "run 7", True)
    assert episode.time_origin == -0.05
    assert dict(episode.context) == {"task": "reach", "load": 2}
    assert repr(episode) == (
        "Trajectory(steps=3, d_s=2, d_a=1, p=1, d_r=1, duration=0.4, terminated=True)"
    )


def test_defaults_are_absent_fields_and_unit_steps():
    episode = Trajectory(STATES)
    for field in ("actions", "rewards", "params", "references", "group"):
        assert getattr(episode, field) is None
    np.testing.assert_array_equal(episode.times, np.arange(4.0))
    assert np.isnan(episode.time_origin)
    assert np.isnan(Trajectory(STATES, time_origin=None).time_origin)
    assert not episode.terminated
    np.testing.assert_array_equal(Trajectory(STATES, dt=0.5).times, [0.0, 0.5, 1.0, 1.5])


@pytest.mark.parametrize("dtype", [np.float32, np.int16, bool, object])
def test_numbers_of_any_type_become_float64(dtype):
    episode = Trajectory(np.eye(3).astype(dtype), actions=np.ones((2, 1), dtype=dtype))
    assert episode.states.dtype == episode.actions.dtype == np.float64
    np.testing.assert_array_equal(episode.states, np.eye(3))


def test_p_zero_and_empty_blocks_mean_absent():
    episode = Trajectory(
        STATES, params=[], actions=np.empty((3, 0)), references=np.empty((4, 0)), context={}
    )
    assert episode.params is episode.actions is episode.references is None


def test_constant_theta_by_step_collapses_and_changing_theta_stays():
    assert Trajectory(STATES, params=[[2.0, 1.0]] * 3).params.tolist() == [2.0, 1.0]
    assert Trajectory(STATES, params=[[2.0], [2.0], [1.0]]).params.shape == (3, 1)


def test_nothing_can_be_changed_from_inside_or_outside():
    given = STATES.copy()
    episode = Trajectory(given, context={"task": "a"})
    given[0, 0] = 99.0
    assert episode.states[0, 0] == 0.0
    assert given.flags.writeable
    with pytest.raises(AttributeError, match="make a new one"):
        episode.states = given
    with pytest.raises(ValueError, match="read-only"):
        episode.states[0] = 1.0
    with pytest.raises(TypeError):
        episode.context["task"] = "b"


@pytest.mark.parametrize(
    "restore",
    [
        lambda episode: pickle.loads(pickle.dumps(episode)),
        copy.deepcopy,
        lambda episode: Trajectory(**episode.to_dict()),
    ],
)
def test_copies_are_equal_and_frozen(restore):
    episode, copied = full(), restore(full())
    for name, value in episode.to_dict().items():
        np.testing.assert_equal(copied.to_dict()[name], value)
    assert not copied.states.flags.writeable


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"states": [1.0, 2.0]}, r"states has shape \(2,\); expected a 2-D"),
        ({"states": [[1.0, 2.0]]}, r"states has 1 row.*at least 2"),
        ({"states": np.empty((0, 2))}, r"states has 0 row"),
        ({"states": np.empty((4, 0))}, "states has no columns"),
        ({"states": [["a"], ["b"]]}, "states is not an array of numbers"),
        ({"states": [[1.0], [1.0, 2.0]]}, "states is not an array of numbers"),
        ({"states": STATES + 1j}, "not an array of numbers.*complex"),
        ({"states": None}, "states"),
        ({"states": np.where(STATES == 5, np.nan, STATES)}, "states is nan at row 2, column 1"),
        ({"states": np.where(STATES == 5, -np.inf, STATES)}, "states is -inf at row 2, column 1"),
        ({"states": np.ma.masked_equal(STATES, 2.0)}, "states is nan at row 1, column 0"),
        ({"actions": np.ones((4, 1))}, "actions has 4 rows.*need 3.*drop the last row"),
        ({"actions": np.ones((2, 1))}, "actions has 2 rows.*need 3"),
        ({"actions": np.ones(3)}, r"actions has shape \(3,\)"),
        ({"actions": [[1.0], [np.nan], [1.0]]}, "actions is nan at row 1, column 0"),
        ({"rewards": np.ones(4)}, "rewards has 4 rows.*need 3"),
        ({"rewards": np.ones((3, 1))}, r"rewards has shape \(3, 1\); expected one number a row"),
        ({"rewards": [0.0, np.inf, 0.0]}, "rewards is inf at row 1"),
        ({"params": 3.0}, r"params has shape \(\)"),
        ({"params": np.ones((4, 2))}, "params has 4 rows.*need 3"),
        ({"params": [np.nan]}, "params is nan at row 0"),
        ({"params": [[1.0], [2.0], [np.nan]]}, "params is nan at row 2"),
        ({"references": np.ones((3, 1))}, "references has 3 rows.*need 4"),
        ({"times": [0.0, 1.0, 2.0]}, "times has 3 rows.*need 4"),
        ({"times": [0.0, 2.0, 1.0, 3.0]}, "times must increase strictly.*from 2.0 to 1.0 at row 1"),
        ({"times": [0.0, 1.0, 1.0, 3.0]}, "from 1.0 to 1.0 at row 1"),
        ({"times": [0.0, 1.0, np.nan, 3.0]}, "times is nan at row 2"),
        ({"dt": 0.0}, "dt = 0.0 must be positive"),
        ({"dt": -0.1}, "dt = -0.1 must be positive"),
        ({"dt": np.inf}, "dt = inf must be positive and finite"),
        ({"time_origin": np.inf}, "time_origin is infinite"),
        ({"terminated": np.nan}, "terminated is nan; give True or False"),
        ({"terminated": "no"}, "terminated is 'no'"),
        ({"group": np.nan}, "group is missing"),
        ({"group": ("a", 1)}, "group must be all text"),
        ({"group": np.arange(2)}, "group must be all text"),
        ({"group": 0.5}, "group must be all text.*float"),
        ({"context": {"task": None}}, "context 'task' is missing"),
        ({"context": {"task": 1.5}}, "context 'task' must be all text"),
    ],
)
def test_bad_input_is_named(fields, match):
    with pytest.raises(InvalidEpisodeError, match=match) as error:
        Trajectory(**({"states": STATES, "id": "run 7"} | fields))
    assert isinstance(error.value, ValueError)
    if "dt" not in fields and "group" not in fields and "context" not in fields:
        assert "episode run 7" in str(error.value)
