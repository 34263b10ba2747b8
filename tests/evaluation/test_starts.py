import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trajlearn import TrajectoryDataset
from trajlearn.evaluation import starts_every


def episodes(lengths, **fields):
    return TrajectoryDataset.from_arrays([np.zeros((n + 1, 1)) for n in lengths], **fields)


def as_lists(starts):
    return [own.tolist() for own in starts]


@given(
    lengths=st.lists(st.integers(1, 40), min_size=1, max_size=5),
    stride=st.integers(1, 12),
    horizon=st.integers(1, 5),
    data=st.data(),
)
def test_starts_are_those_that_a_loop_finds(lengths, stride, horizon, data):
    lengths = [40, *lengths]
    first = data.draw(st.lists(st.integers(0, 30), min_size=len(lengths), max_size=len(lengths)))
    expected = [
        [s for s in range(begin, steps + 1) if (s - begin) % stride == 0 and s + horizon <= steps]
        for begin, steps in zip(first, lengths)
    ]
    found = starts_every(episodes(lengths), stride, first=first, horizon=horizon)
    assert as_lists(found) == expected
    if len(set(first)) == 1:
        again = starts_every(episodes(lengths), stride, first=first[0], horizon=horizon)
        assert as_lists(again) == expected


def test_the_motion_begins_at_the_first_state_after_its_origin():
    # states at 0, 0.1, ... 1; an origin between two, before the log, after it, on a sample
    # and so close after one that only rounding can have parted them
    ds = episodes([10] * 5, dt=0.1, time_origin=[0.31, -0.55, 1.2, 0.3, 0.3 + 1e-9])
    late = [3, 6, 9]
    expected = [[4, 7], [0, *late], [], late, late]
    assert as_lists(starts_every(ds, 3, first="motion")) == expected
    assert as_lists(starts_every(list(ds), 3, first="motion")) == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stride": 0}, "stride = 0 must be a whole number of steps"),
        ({"stride": 1.5}, r"stride = 1\.5"),
        ({"stride": 1, "horizon": 0}, "horizon = 0"),
        ({"stride": 1, "first": -1}, "first = -1 must be an index from 0 on"),
        ({"stride": 1, "first": [0, 1, 2]}, r"one per episode \(2,\)"),
        ({"stride": 1, "first": 0.5}, r"first = 0\.5 must be an index"),
        ({"stride": 1, "first": "begin"}, 'give an index, one per episode, or "motion"'),
        ({"stride": 1, "first": "motion"}, "unknown in 1 episodes, the first of them b"),
        ({"stride": 1, "first": 3, "horizon": 3}, "no episode has 3 steps.*the longest has 2"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    ds = episodes([5, 4], ids=["a", "b"], time_origin=[0.0, np.nan])
    with pytest.raises(ValueError, match=message):
        starts_every(ds, **arguments)
