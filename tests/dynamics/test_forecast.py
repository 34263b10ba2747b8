"""The container of a forecast, by itself."""

import pickle

import numpy as np
import pytest
from scipy.stats import norm

from trajlearn import Forecast, TrajectoryDataset
from trajlearn.dynamics._uncertainty.calibration import Residuals
from trajlearn.dynamics._uncertainty.conformal import marginal_bands


def make(lengths=(3, 2, 4), *, n_steps=None, diverged=(0, 0, 0), seed=0, samples=5, **changes):
    rng = np.random.default_rng(seed)
    lengths, diverged = np.array(lengths), np.array(diverged)
    n, n_steps = len(lengths), n_steps or max(lengths)
    step = np.arange(1, n_steps + 1)
    mean = rng.normal(size=(n, n_steps, 2))
    fields = {
        "mean": mean,
        "std": np.abs(rng.normal(size=mean.shape)),
        "samples": rng.normal(size=(samples, *mean.shape)) if samples else None,
        "times": np.tile(0.5 * step, (n, 1)),
    }
    gone = (diverged > 0)[:, None] & (step >= diverged[:, None])
    for name in ("mean", "std", "samples"):
        if fields[name] is not None:
            fields[name][..., gone, :] = np.inf
            fields[name][..., step > lengths[:, None], :] = np.nan
    return Forecast(
        **fields
        | {
            "horizons": step,
            "lengths": lengths,
            "initial_states": rng.normal(size=(n, 2)),
            "initial_times": np.zeros(n),
            "start": np.zeros(n, dtype=int),
            "diverged_at": diverged,
            "state_range": np.array([[0.0, -1.0], [2.0, 1.0]]),
            "state_names": ("x", "v"),
        }
        | changes
    )


def logged(forecast):
    return TrajectoryDataset.from_arrays(
        [
            np.vstack([s, np.zeros((k, 2))])
            for s, k in zip(forecast.initial_states, forecast.lengths)
        ],
        dt=0.5,
        state_names=forecast.state_names,
    )


def test_as_an_array_it_is_its_mean():
    forecast = make()
    assert np.asarray(forecast) is not None
    np.testing.assert_array_equal(np.asarray(forecast), forecast.mean)
    assert np.asarray(forecast, dtype=np.float32).dtype == np.float32
    np.testing.assert_array_equal(np.nanmean(forecast, axis=0), np.nanmean(forecast.mean, axis=0))
    np.testing.assert_array_equal(np.stack([forecast, forecast])[1], forecast.mean)
    np.testing.assert_array_equal(
        np.concatenate([forecast, forecast], axis=1), np.concatenate([forecast.mean] * 2, axis=1)
    )
    assert len(forecast) == 3
    assert forecast.shape == (3,)


@pytest.mark.parametrize(
    "key", [1, -1, slice(0, 2), [2, 0], np.array([True, False, True]), (np.array([1]), ...)]
)
def test_indexing_takes_every_field_along(key):
    forecast = make(diverged=(0, 2, 0), episode=np.array([4, 4, 5]))
    index = np.atleast_1d(np.arange(3)[key[0] if isinstance(key, tuple) else key])
    part = forecast[key]
    assert len(part) == len(index)
    for name in ("mean", "std", "times", "lengths", "diverged_at", "start", "episode"):
        np.testing.assert_array_equal(getattr(part, name), getattr(forecast, name)[index])
    np.testing.assert_array_equal(part.samples, forecast.samples[:, index])
    assert part.state_names == ("x", "v")


def test_joining_pads_to_the_longest():
    short, long = make((2, 1)[:1] * 3), make((5, 4, 3), seed=1)
    joined = np.concatenate([short, long])
    assert joined.mean.shape == (6, 5, 2)
    assert joined.samples.shape == (5, 6, 5, 2)
    np.testing.assert_array_equal(joined.mean[:3, :2], short.mean)
    assert np.isnan(joined.mean[:3, 2:]).all()
    assert np.isnan(joined.times[:3, 2:]).all()
    np.testing.assert_array_equal(joined.std[3:], long.std)
    assert joined.lengths.tolist() == [2, 2, 2, 5, 4, 3]
    np.testing.assert_array_equal(joined[:3].at([1, 2]).mean, short.mean)
    without = np.concatenate([short, make(samples=0)])
    assert without.samples is None
    assert without.std is not None


def test_joining_widens_the_range():
    other = make(state_range=np.array([[-3.0, 0.0], [1.0, 5.0]]))
    joined = np.concatenate([make(), other])
    np.testing.assert_array_equal(joined.state_range, [[-3.0, -1.0], [2.0, 5.0]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": "policy"}, "actions came from"),
        ({"horizons": np.array([2, 3, 4, 5])}, "different horizons"),
        ({"episode": np.arange(3)}, "several starts"),
    ],
)
def test_what_does_not_fit_is_not_joined(changes, message):
    with pytest.raises(ValueError, match=message):
        np.concatenate([make(), make(**changes)])


def test_at_picks_horizons_and_moves_the_counts_along():
    forecast = make((6, 3, 6), diverged=(0, 0, 4))
    part = forecast.at([2, 3, 5])
    np.testing.assert_array_equal(part.mean, forecast.mean[:, [1, 2, 4]])
    assert part.horizons.tolist() == [2, 3, 5]
    assert part.lengths.tolist() == [3, 2, 3]
    assert part.diverged_at.tolist() == [0, 0, 3]
    assert forecast.at([1, 2]).diverged_at.tolist() == [0, 0, 0]
    fourth = forecast.at(4)
    assert fourth.mean.shape == (3, 1, 2)
    assert fourth.lengths.tolist() == [1, 0, 1]
    assert fourth.diverged_at.tolist() == [0, 0, 1]
    with pytest.raises(ValueError, match=r"\[9\] were not predicted"):
        forecast.at([1, 9])
    with pytest.raises(ValueError, match="increase strictly"):
        forecast.at([3, 2])


def test_gaussian_intervals_hold_their_share():
    forecast = make(samples=0)
    lower, upper = forecast.interval(0.8)
    known = ~np.isnan(forecast.mean)
    np.testing.assert_allclose(upper - lower, 2 * norm.ppf(0.9) * forecast.std)
    np.testing.assert_allclose(((upper + lower) / 2)[known], forecast.mean[known])
    wide = np.subtract(*forecast.interval(0.99)[::-1])
    assert (wide[known] > (upper - lower)[known]).all()


def test_intervals_of_samples_are_their_quantiles():
    forecast = make(samples=2001)
    lower, upper = forecast.interval(0.5)
    np.testing.assert_allclose(upper, np.quantile(forecast.samples, 0.75, axis=0, method="weibull"))
    assert 0.45 < np.nanmean(lower < 0) < 1
    assert np.isnan(lower[1, 2:]).all()


def test_intervals_of_few_samples_cover_what_they_say():
    draws = np.random.default_rng(0).normal(size=(20, 1, 4000, 1))
    forecast = make(lengths=(4000,), diverged=(0,), samples=20)
    forecast.samples = draws[:, :, :, [0, 0]]
    lower, upper = forecast.interval(0.8)
    # the probability of a standard normal between them, on average over draws
    inside = norm.cdf(upper) - norm.cdf(lower)
    np.testing.assert_allclose(inside.mean(), 0.8, atol=0.005)


def test_intervals_are_unbounded_where_samples_diverged():
    forecast = make(samples=20)
    forecast.samples[:12, 0, 1:] = np.inf
    lower, upper = forecast.interval(0.8)
    assert np.isfinite(lower[0, 0]).all()
    assert np.isinf(upper[0, 1:]).all()
    assert not np.isnan(lower[0]).any()


@pytest.mark.parametrize("level", [0, 1, 1.5, -0.1])
def test_a_level_is_a_probability(level):
    with pytest.raises(ValueError, match="between 0 and 1"):
        make().interval(level)


def test_without_uncertainty_there_is_no_interval():
    with pytest.raises(ValueError, match="return_std=True or n_samples="):
        make(std=None, samples=0).interval()


def bands(n, size):
    """Shared by n forecasts: 9 scores of `size` at up to 4 steps of two states."""
    elapsed = 0.5 * np.arange(1, 5)
    scores = Residuals(np.full((9, 4, 2), size), np.ones((9, 4, 2)), np.tile(elapsed, (9, 1)))
    one = marginal_bands(scores, elapsed)
    return np.full(n, one, dtype=object)


def test_bands_come_before_samples():
    raw_std = 2 * make().std
    forecast = make(bands=bands(3, 3.0), raw_std=raw_std)
    lower, upper = forecast.interval(0.9)
    known = ~np.isnan(forecast.mean)
    np.testing.assert_allclose(upper, forecast.mean + 3 * raw_std)
    np.testing.assert_allclose(lower, forecast.mean - 3 * raw_std)
    assert np.isfinite(upper[known]).all()
    assert np.isnan(upper[~known]).all()
    with pytest.raises(ValueError, match="bands need raw_std"):
        make(bands=bands(3, 3.0))


def test_bands_go_along():
    first, second = (
        make(bands=bands(3, size), raw_std=size * make().std, seed=seed)
        for seed, size in enumerate((1.0, 2.0))
    )
    joined = np.concatenate([first, second])
    width = (joined.interval(0.5)[1] - joined.mean) / joined.raw_std
    np.testing.assert_allclose(width[:3][~np.isnan(width[:3])], 1.0)
    np.testing.assert_allclose(width[3:][~np.isnan(width[3:])], 2.0)
    np.testing.assert_array_equal(joined[[4, 0]].interval(0.5)[0], joined.interval(0.5)[0][[4, 0]])
    np.testing.assert_array_equal(
        joined.at([2, 3]).interval(0.5)[0], joined.interval(0.5)[0][:, [1, 2]]
    )
    assert repr(first) == "Forecast(n=3, H=4, d_s=2, std, samples=5, bands)"
    # a guarantee must not be lost on the way
    with pytest.raises(ValueError, match="others have none"):
        np.concatenate([first, make()])


def test_residuals_are_logged_minus_predicted():
    forecast = make(diverged=(0, 0, 3))
    residuals = forecast.residuals(logged(forecast))
    np.testing.assert_array_equal(residuals[0, :3], -forecast.mean[0, :3])
    assert np.isnan(residuals[1, 2:]).all()
    assert np.isposinf(residuals[2, 2:]).all()


def test_squared_errors_are_in_training_ranges():
    forecast = make(diverged=(0, 0, 3))
    squared = forecast.squared_errors(logged(forecast))
    expected = (forecast.mean / 2.0) ** 2
    np.testing.assert_allclose(squared[0], expected[0])
    assert np.isnan(squared[1, 2:]).all()
    assert np.isposinf(squared[2, 2:]).all()
    np.testing.assert_allclose(squared[2, :2], expected[2, :2])


def test_a_diverged_step_is_infinitely_wrong_whatever_stands_there():
    forecast = make(diverged=(0, 2, 0))
    forecast.mean[1, 1] = np.nan
    assert np.isposinf(forecast.squared_errors(logged(forecast))[1, 1]).all()


def test_a_constant_state_has_range_one():
    forecast = make(state_range=np.array([[5.0, 0.0], [5.0, 2.0]]))
    squared = forecast.squared_errors(logged(forecast))
    np.testing.assert_allclose(squared[0, :, 0], forecast.mean[0, :, 0] ** 2)


def test_errors_follow_starts_and_episodes():
    states = np.arange(10.0)[:, None] * np.ones(2)
    ds = TrajectoryDataset.from_arrays([states, 100 + states])
    forecast = make(
        (2, 2, 2),
        mean=np.zeros((3, 2, 2)),
        start=np.array([0, 7, 8]),
        episode=np.array([0, 0, 1]),
        state_range=np.array([[0.0, 0.0], [1.0, 1.0]]),
    )
    squared = forecast.squared_errors(ds)[:, :, 0]
    np.testing.assert_array_equal(squared, [[1, 4], [64, 81], [109**2, np.nan]])


def test_errors_need_matching_episodes_and_steps():
    forecast = make()
    with pytest.raises(ValueError, match="3 forecasts, but 2 episodes"):
        forecast.squared_errors(logged(forecast)[:2])
    with pytest.raises(ValueError, match="has 2 states"):
        forecast.squared_errors(TrajectoryDataset.from_arrays(np.zeros((3, 5, 1))))
    with pytest.raises(ValueError, match="over times, not steps"):
        make(horizons=0.5 * np.arange(1, 5)).squared_errors(logged(forecast))


def test_as_episodes_the_first_state_leads():
    forecast = make(diverged=(0, 0, 3))
    ds = forecast.to_dataset()
    assert ds.lengths.tolist() == [3, 2, 2]
    assert ds.state_names == ("x", "v")
    np.testing.assert_array_equal(ds[1].states[0], forecast.initial_states[1])
    np.testing.assert_array_equal(ds[2].states[1:], forecast.mean[2, :2])
    np.testing.assert_allclose(ds[0].times, [0, 0.5, 1.0, 1.5])
    with pytest.raises(ValueError, match=r"forecast 1 has no finite step; leave it out"):
        make(diverged=(0, 1, 0)).to_dataset()


def test_as_a_table_padding_is_left_out():
    forecast = make(episode=np.array([3, 3, 7]), start=np.array([0, 2, 1]))
    frame = forecast.to_frame()
    assert len(frame) == 9
    assert list(frame) == ["episode", "start", "horizon", "time", "x", "x_std", "v", "v_std"]
    third = frame[(frame.episode == 7) & (frame.horizon == 3)].iloc[0]
    assert third.start == 1
    assert third.time == 1.5
    assert third.v == forecast.mean[2, 2, 1]
    assert "x_std" not in make(std=None).to_frame()


def test_repr_and_pickle():
    forecast = make(diverged=(0, 2, 0), actions="logged")
    assert repr(forecast) == (
        "Forecast(n=3, H=4, d_s=2, std, samples=5, actions='logged', diverged=1)"
    )
    again = pickle.loads(pickle.dumps(forecast))
    np.testing.assert_array_equal(again.samples, forecast.samples)
