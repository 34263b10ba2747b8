"""Alignment of references: known shifts, scales and gaps must come back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trajlearn.datasets import align_references
from trajlearn.exceptions import InvalidEpisodeError

DURATION = 3.6


def path(time):
    """Half a metre along x while going 1 m out and back along y, smooth, from time 0."""
    phase = np.clip(np.asarray(time) / DURATION, 0, 1)
    return np.stack(
        [0.5 * (10 - 15 * phase + 6 * phase**2) * phase**3, 64 * (phase * (1 - phase)) ** 3], 1
    )


def velocity(time):
    step = 1e-5
    return (path(time + step) - path(time - step)) / (2 * step)


def onset():
    """When the speed passes a hundredth of its peak."""
    time = np.arange(0, DURATION, 1e-4)
    speed = np.linalg.norm(velocity(time), axis=1)
    return time[np.argmax(speed > 0.01 * speed.max())]


def flight(start, *, scale=1.0, begin=0.0, end=6.0, noise=None, dt=0.02):
    """Times since the log began at `begin`, positions and velocities as a log keeps them."""
    time = np.arange(begin, end, dt)
    position, speed = path((time - start) / scale), velocity((time - start) / scale) / scale
    if noise is not None:
        position = position + 5e-4 * noise.normal(size=position.shape)
        speed = speed + 5e-4 * noise.normal(size=speed.shape)
    # Whole millimetres, cut off as the firmware does.
    return time - begin, np.trunc(position * 1e3) / 1e3, np.trunc(speed * 1e3) / 1e3


def align(flights, **settings):
    return align_references(*zip(*flights), **settings)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_shifts_come_back_to_a_millisecond(seed):
    rng = np.random.default_rng(seed)
    n = 12
    start = rng.uniform(0.2, 1.0, n)
    # Half of the logs begin up to 1.2 s into the motion; they end at different times.
    begin = np.where(np.arange(n) % 2, start + rng.uniform(0, 1.2, n), 0.0)
    end = rng.uniform(5.0, 7.0, n)
    found = align([flight(s, begin=b, end=e, noise=rng) for s, b, e in zip(start, begin, end)])
    error = found.time_origin - (start - begin)
    assert np.ptp(error) < 1e-3
    assert np.abs(error - onset()).max() < 0.01
    assert (found.time_origin < 0).any()
    np.testing.assert_array_equal(found.time_scale, 1.0)
    assert found.residual.max() < 2e-3


def test_other_speeds_are_found_and_do_not_spoil_the_path():
    starts, scales = [0.5, 0.41, 0.633, 0.7, 0.3, 0.55], [1.0, 4 / 3, 1.0, 2 / 3, 1.0, 1.0]
    flights = [flight(s, scale=c, end=7.0) for s, c in zip(starts, scales)]
    found = align(flights)
    np.testing.assert_allclose(found.time_scale, scales, rtol=2e-3)
    assert (found.time_scale == 1).tolist() == [c == 1 for c in scales]
    alone = align([flights[i] for i in (0, 2, 4, 5)])
    np.testing.assert_allclose(found.time_origin[[0, 2, 4, 5]], alone.time_origin, atol=1e-4)
    # A slower flight also passes the threshold later.
    np.testing.assert_allclose(found.time_origin - starts, onset() * np.array(scales), atol=0.01)


def test_the_usual_speed_is_that_of_most_flights_even_if_few_log_the_whole_motion():
    slow = [flight(0.5 + 0.03 * i, scale=4 / 3, end=8.0) for i in range(2)]
    whole = [flight(0.5)]
    late = [flight(0.3, begin=0.5 + 0.1 * i) for i in range(6)]
    found = align([*slow, *whole, *late])
    np.testing.assert_allclose(found.time_scale, [4 / 3] * 2 + [1] * 7, rtol=2e-3)
    np.testing.assert_allclose(np.diff(found.time_origin[3:]), -0.1, atol=1e-3)


def test_what_the_reference_does_after_the_motion_does_not_move_the_origin():
    plain = [flight(0.5 + 0.0371 * i) for i in range(4)]
    time, position, speed = (np.copy(x) for x in plain[-1])
    position[time > 5, 1] += 1e-3
    speed[time > 5.5] = 2e-3
    found = align([*plain[:-1], (time, position, speed)])
    np.testing.assert_allclose(found.time_origin, align(plain).time_origin, atol=1e-3)


def test_flights_that_leave_the_path_or_stand_still_have_no_origin():
    broken = [np.copy(x) for x in flight(0.5)]
    broken[1][broken[0] > 2] = broken[2][broken[0] > 2] = 0
    still = flight(100.0)
    found = align([flight(0.5), flight(0.6), broken, still, flight(0.7)])
    assert np.isnan(found.time_origin).tolist() == [False, False, True, True, False]
    np.testing.assert_array_equal(np.isnan(found.time_scale), np.isnan(found.time_origin))
    assert found.residual[2] > 0.1
    assert found.residual[3] == np.inf
    assert np.isnan(align([still]).time_origin).all()


def test_tolerances_decide_who_matches_and_who_is_only_shifted():
    rough = [np.copy(x) for x in flight(0.6)]
    rough[1][:, 0] += 0.02 * (np.arange(len(rough[0])) % 2)
    flights = [flight(0.5), rough, flight(0.55, scale=1.01), flight(0.52)]
    found = align(flights)
    assert np.isnan(found.time_origin).tolist() == [False, True, False, False]
    assert found.time_scale[2] == 1
    found = align(flights, tolerance=0.03, scale_tolerance=0.005)
    assert not np.isnan(found.time_origin).any()
    assert found.time_scale[2] == pytest.approx(1.01, abs=2e-3)


def test_origins_move_with_the_clock():
    flights = [flight(0.5), flight(0.7), flight(0.3, begin=0.6)]
    shifted = [(time + 100 * i, *rest) for i, (time, *rest) in enumerate(flights)]
    np.testing.assert_allclose(
        align(shifted).time_origin, np.add(align(flights).time_origin, [0, 100, 200]), atol=1e-6
    )


def test_without_the_whole_motion_there_is_no_beginning():
    with pytest.raises(InvalidEpisodeError, match="logs the whole motion"):
        align([flight(0.5, begin=0.9), flight(0.5, begin=1.0)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, p, v: (t[:-1], p, v), r"flight 1 has times \(299,\), positions \(300, 2\)"),
        (lambda t, p, v: (t, p, v[:, :1]), r"velocities \(300, 1\)"),
        (lambda t, p, v: (t[:1], p[:1], v[:1]), "m > 1"),
        (lambda t, p, v: (t, np.where(t[:, None] > 1, np.nan, p), v), "missing or infinite"),
        (lambda t, p, v: (t[::-1], p, v), "do not increase"),
    ],
    ids=["times", "velocities", "short", "nan", "order"],
)
def test_bad_logs_are_named(change, message):
    with pytest.raises(InvalidEpisodeError, match=message):
        align([flight(0.5), change(*flight(0.6))])
