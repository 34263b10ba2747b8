"""Forecasts that are off by Gaussian noise of known size."""

import numpy as np

from trajlearn import Forecast, TrajectoryDataset

RANGE = np.array([4.0, 0.5, 30.0])


def walks(rng, lengths, d_s=2):
    """Random episodes of states of very different size."""
    states = [rng.normal(size=(steps + 1, d_s)) * RANGE[:d_s] for steps in lengths]
    return TrajectoryDataset.from_arrays(states, state_names=["x", "y", "z"][:d_s])


def around(ds, rng, *, starts=None, factor=1.0, n_samples=0, with_std=True, diverging=0.0, extra=0):
    """Forecast of `ds` with errors of a random std in each cell, which it says times `factor`.

    `starts`: a sequence of starts an episode; `extra`: columns of padding at the end.
    """
    several = starts is not None
    starts = starts if several else [[0]] * len(ds)
    episode = np.repeat(np.arange(len(ds)), [len(own) for own in starts])
    start = np.concatenate([np.asarray(own, dtype=np.intp) for own in starts])
    d_s = ds.states.shape[1]
    lengths = ds.lengths[episode] - start
    horizons = np.arange(1, lengths.max() + extra + 1)
    known = horizons <= lengths[:, None]
    first = ds.offsets[:-1][episode] + start
    rows = np.where(known, first[:, None] + horizons, 0)
    std = rng.uniform(0.05, 0.2, size=(*known.shape, d_s)) * RANGE[:d_s]
    mean = ds.states[rows] + rng.normal(size=std.shape) * std
    samples = mean + rng.normal(size=(n_samples, *std.shape)) * std * factor
    std = std * factor
    hit = rng.random(len(start)) < diverging
    diverged_at = np.where(hit, rng.integers(1, lengths + 1), 0)
    gone = (diverged_at > 0)[:, None] & (horizons >= diverged_at[:, None])
    for values in (mean, std, samples):
        values[..., gone, :] = np.inf
        values[..., ~known, :] = np.nan
    return Forecast(
        mean,
        times=np.where(known, ds.times[rows], np.nan),
        horizons=horizons,
        lengths=lengths,
        initial_states=ds.states[first],
        initial_times=ds.times[first],
        start=start,
        diverged_at=diverged_at,
        state_range=np.stack([np.zeros(d_s), RANGE[:d_s]]),
        state_names=ds.state_names,
        std=std if with_std else None,
        samples=samples if n_samples else None,
        episode=episode if several else None,
    )


def of_numbers(truth, mean, std=None, samples=None, *, width=1.0):
    """One state, one episode a number, one step: cells whose scores are known by hand."""
    truth, mean = (np.atleast_1d(np.asarray(values, dtype=float)) for values in (truth, mean))
    n = len(truth)
    states = np.stack([np.zeros(n), truth], axis=1)[..., None]
    cell = (n, 1, 1)
    forecast = Forecast(
        np.broadcast_to(mean, n).reshape(cell).copy(),
        times=np.ones((n, 1)),
        horizons=np.array([1]),
        lengths=np.ones(n, dtype=np.intp),
        initial_states=np.zeros((n, 1)),
        initial_times=np.zeros(n),
        start=np.zeros(n, dtype=np.intp),
        diverged_at=np.zeros(n, dtype=np.intp),
        state_range=np.array([[0.0], [width]]),
        state_names=("s0",),
        std=None if std is None else np.broadcast_to(np.asarray(std, float), n).reshape(cell),
        samples=None if samples is None else np.reshape(samples, (-1, *cell)).astype(float),
    )
    return forecast, TrajectoryDataset.from_arrays(states)
