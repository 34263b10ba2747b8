"""Training on noisy states: the learned step smooths them, and is learned again from the result.

Least squares on noisy states learns slopes that are too small, and noise where it can. The rounds
here are those of expectation-maximisation: states are smoothed with the step learned so far, the
logged actions and the noise as estimated, and the step is learned again from smoothed states.
With little process noise such rounds hardly move (the smoother believes the step); so they begin
with much of it and take it back.

References
----------
Z. Ghahramani and S. T. Roweis, "Learning nonlinear dynamical systems using an EM algorithm",
NeurIPS 1998.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from trajlearn.dynamics._denoising.noise import (
    NoiseModel,
    least_variance,
    likeliest,
    residual_noise,
    start_of,
)
from trajlearn.dynamics._denoising.slopes import StepSlopes, step_slopes
from trajlearn.dynamics._denoising.smoother import Problem
from trajlearn.dynamics._learner import fit_learner
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._columns import Columns, runs

__all__ = ["Smoother", "estimate_noise", "first_noise", "round_learner", "with_states"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# Least process noise of each round, in half the variance of the residuals; from the third round on
# the likelihood may ask for more.
_INFLATION = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
_SILENT = 2
# What goes before where a part of the states is a guess only.
_OF_A_GUESS = (100.0, 30.0, 10.0, 3.0)
# Rounds end when states move by less than this, in standard deviations of the noise.
_SETTLED = 0.01
# Gradient steps of a network in a round.
_STEPS = 500
# States of a stretch that is smoothed in one go, and how far it goes on beyond on both sides.
_STRETCH, _MARGIN = 512, 64
# Cells (stretches times the longest) that are smoothed side by side.
_CELLS = 2**15
# Stretches that the likelihood is summed over, and states in each.
_FEW, _SHORT = 32, 200
# Residuals of less than this, in the variance of the state, are round-off (a state that never
# changes has none): the smoother divides by them.
_SURELY_NONE = 1e-12
# How much wider than all states a state is that nothing is known of: variance.
_VAGUE = 1e4
# Solutions about the last one that smoothing takes at most.
_ITERATIONS = 10


@dataclass(frozen=True, eq=False)
class _Stretches:
    """Pieces of episodes: rows of states, which of them are kept, which begin an episode."""

    rows: Ints
    """(L, n)."""
    known: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    first: NDArray[np.bool_]
    """(n,)."""

    @classmethod
    def of(cls, begin: Ints, count: Ints, keep: Ints, n_kept: Ints, first: Any) -> "_Stretches":
        index = np.arange(count.max())[:, None]
        rows = begin + np.minimum(index, count - 1)
        kept = (rows >= keep) & (rows < keep + n_kept) & (index < count)
        return cls(rows, index < count, kept, np.asarray(first, dtype=bool))


class Smoother:
    """Episodes to be smoothed by the step of a fitted one-step model.

    Parameters
    ----------
    model : RollingEstimator
        Fitted.
    ds : TrajectoryDataset
        With the states of the step, the m measured ones first.
    n_measured : int
        m.

    Attributes
    ----------
    episode : ndarray of shape (n_steps,)
        Episode of each step.
    still : ndarray of bool of shape (d,)
        States that never changed in training.
    """

    def __init__(self, model: Any, ds: TrajectoryDataset, n_measured: int) -> None:
        self.model, self.ds, self.n_measured = model, ds, n_measured
        self._measured = ds.states[:, :n_measured]
        begin = np.ones(len(ds.states), dtype=bool)
        begin[ds.offsets[1:] - 1] = False
        self._begin = np.flatnonzero(begin)
        self.episode = np.searchsorted(ds.offsets, self._begin, side="right") - 1
        self._rows = model.relabeler_.rows(ds, self.episode, self._begin, self._begin + 1)
        self.still = np.ptp(model.rolled_range_, axis=0) == 0

    def step(self, states: Floats) -> tuple[Floats, Floats]:
        """What follows each state but the last of an episode, and its slopes."""
        return self._at(states, self._begin, step_slopes(self.model))

    @property
    def ends(self) -> Ints:
        """Rows of the states that follow."""
        return self._begin + 1

    def _at(self, states: Floats, begin: Ints, step: StepSlopes) -> tuple[Floats, Floats]:
        # as many episodes have ended before a state as it has fewer steps before it
        rows = self._rows[begin - np.searchsorted(self.ds.offsets, begin, side="right") + 1]
        rows[:, self.model.layout_["state"]] = states[begin]
        return step(rows)

    def _problem(self, states: Floats, pieces: _Stretches, step: StepSlopes) -> Problem:
        follows = pieces.known[1:]
        d = states.shape[1]
        after, slopes = np.zeros((*follows.shape, d)), np.zeros((*follows.shape, d, d))
        after[follows], slopes[follows] = self._at(states, pieces.rows[:-1][follows], step)
        measured = self._measured[pieces.rows]
        return Problem(measured, pieces.known, states[pieces.rows], after, slopes)

    def likeliest(self, states: Floats, noise: NoiseModel, least: Floats) -> NoiseModel:
        """Noise of greatest likelihood on some of the episodes, about given states."""
        pieces = self._few()
        problem = self._problem(states, pieces, step_slopes(self.model))
        return likeliest(problem, pieces.first, noise, least)

    def deviance(self, states: Floats, noise: NoiseModel) -> float:
        """-2 log likelihood, with the noise of greatest likelihood, of some of the episodes."""
        pieces = self._few()
        problem = self._problem(states, pieces, step_slopes(self.model))
        found = likeliest(problem, pieces.first, noise, least_variance(noise.process))
        return found.smoothed(problem, pieces.first).deviance

    def pass_over(self, states: Floats, noise: NoiseModel) -> tuple[Floats, Floats]:
        """Smooth all states once, linearised about given ones.

        Returns
        -------
        states : ndarray of shape (rows, d)
        start_covariance : ndarray of shape (n, d, d)
            Of the first states.
        """
        found, step = np.empty_like(states), step_slopes(self.model)
        covariance = np.empty((len(self.ds), states.shape[1], states.shape[1]))
        for pieces in self._pieces():
            posterior = noise.smoothed(self._problem(states, pieces, step), pieces.first)
            found[pieces.rows[pieces.kept]] = posterior.mean[pieces.kept]
            of = np.searchsorted(self.ds.offsets, pieces.rows[0, pieces.first])
            covariance[of] = posterior.covariance[0, pieces.first]
        # what never changes has no noise, and a learner would blow up what round-off adds
        found[:, self.still] = states[:, self.still]
        return found, covariance

    def smoothed(self, states: Floats, noise: NoiseModel) -> Floats:
        """Smooth until the states agree with the slopes at them."""
        for _ in range(_ITERATIONS):
            before = states
            states, _ = self.pass_over(states, noise)
            if _moved(states - before, noise) < _SETTLED:
                break
        return states

    def _pieces(self) -> Iterator[_Stretches]:
        """All states, in stretches of like lengths."""
        counts = self.ds.lengths + 1
        n_pieces = -(-counts // _STRETCH)
        episode = np.repeat(np.arange(len(counts)), n_pieces)
        size = -(-counts // n_pieces)[episode]
        at = runs(np.zeros_like(n_pieces), n_pieces) * size
        begin = np.maximum(at - _MARGIN, 0)
        end = np.minimum(at + size + _MARGIN, counts[episode])
        order = np.argsort(end - begin, kind="stable")
        while len(order):
            cells = (end - begin)[order] * np.arange(1, len(order) + 1)
            n = max(1, int(np.searchsorted(cells, _CELLS, side="right")))
            now, order = order[:n], order[n:]
            first = self.ds.offsets[:-1][episode[now]]
            yield _Stretches.of(
                first + begin[now], (end - begin)[now], first + at[now], size[now], begin[now] == 0
            )

    def _few(self) -> _Stretches:
        """Some stretches, spread evenly over the episodes."""
        counts = self.ds.lengths + 1
        n_pieces = -(-counts // _SHORT)
        episode = np.repeat(np.arange(len(counts)), n_pieces)
        size = -(-counts // n_pieces)[episode]
        at = runs(np.zeros_like(n_pieces), n_pieces) * size
        count = np.minimum(size, counts[episode] - at)
        usable = np.flatnonzero(count > 1)
        if len(usable) > _FEW:
            usable = usable[np.linspace(0, len(usable) - 1, _FEW).astype(np.intp)]
        begin = self.ds.offsets[:-1][episode[usable]] + at[usable]
        return _Stretches.of(begin, count[usable], begin, count[usable], at[usable] == 0)


def first_noise(
    smoother: Smoother, states: Floats, measurement: Floats | None = None
) -> tuple[NoiseModel | None, Floats]:
    """Noise to begin with, from the residuals of a step that is fitted on `states`.

    Parameters
    ----------
    smoother : Smoother
    states : ndarray of shape (rows, d)
        As measured, with a guess of what is not.
    measurement : ndarray of shape (m,), optional
        A guess of the variances of the measurement noise. Default: by the residuals.

    Returns
    -------
    noise : NoiseModel or None
        None if the residuals show no measurement noise. Its process noise, half the variance of
        the residuals, is what shares of inflation are of.
    residual : ndarray of shape (d,)
        Variance of the residuals.
    """
    m = smoother.n_measured
    after, slopes = smoother.step(states)
    shown = residual_noise(states[smoother.ends] - after, slopes, smoother.episode)
    # of a constant such as 0.1 it would be round-off
    variance = np.where(smoother.still, 0.0, states.var(axis=0))
    least = _SURELY_NONE * np.where(variance > 0, variance, 1.0)
    unit = np.maximum(shown.residual / 2, least)
    if measurement is None:
        if not shown.found.any():
            return None, shown.residual
        measurement = np.where(shown.found, shown.measurement, _INFLATION[-1] * unit)[:m]
    else:
        # a guess of what is not measured has smoothed the rest
        unit[:m] = np.maximum(unit[:m], measurement)
    spread = _VAGUE * np.maximum(np.maximum(variance, shown.residual), least)
    anywhere = states.mean(axis=0)
    noise = NoiseModel(
        measurement=np.maximum(measurement, least_variance(unit)[:m]),
        process=unit,
        start_mean=anywhere,
        start_covariance=np.diag(spread),
        mean=anywhere,
        spread=spread,
    )
    return noise, shown.residual


def estimate_noise(
    smoother: Smoother,
    states: Floats,
    noise: NoiseModel,
    groups: NDArray[Any] | None,
    *,
    latent: bool = False,
) -> tuple[NoiseModel, Floats]:
    """Noise of the measurements, and states without it.

    The model of the smoother is changed: its learner is that of the last round.

    Parameters
    ----------
    smoother : Smoother
        Its model is fitted on `states`.
    states : ndarray of shape (rows, d)
    noise : NoiseModel
        From `first_noise`.
    groups : ndarray of shape (n,) or None
        By episode.
    latent : bool, default=False
        Whether a part of the states is a guess only, which takes more rounds.

    Returns
    -------
    noise : NoiseModel
    states : ndarray of shape (rows, d)
    """
    model, unit, spread = smoother.model, noise.process, noise.spread
    least = least_variance(unit)
    learner = round_learner(model.estimator_)
    for i, share in enumerate((*_OF_A_GUESS, *_INFLATION) if latent else _INFLATION):
        likely = least
        if i >= _SILENT:
            # from next to none the likelihood shows no way to more
            shown = np.maximum(noise.measurement, share * unit[: smoother.n_measured])
            found = smoother.likeliest(states, replace(noise, measurement=shown), least)
            noise, likely = replace(noise, measurement=found.measurement), found.process
        noise = replace(noise, process=np.maximum(likely, share * unit))
        before = states
        states, covariance = smoother.pass_over(states, noise)
        mean, covariance = start_of(states[smoother.ds.offsets[:-1]], covariance, spread)
        noise = replace(noise, start_mean=mean, start_covariance=covariance)
        learner = _refit(model, with_states(smoother.ds, states), learner, groups)
        settled = _moved(states - before, noise) < _SETTLED
        if settled and (likely >= share * unit).all():
            break
    noise = smoother.likeliest(states, noise, least)
    return noise, smoother.smoothed(states, noise)


def with_states(ds: TrajectoryDataset, states: Floats) -> TrajectoryDataset:
    """The episodes with other states, which were estimated from what follows them, too."""
    new: dict[str, Any] = {"states": states, "hindsight": True}
    names = dict(ds._names)
    if ds.observed is None:
        new["observed"], names["observed"] = ds.states, ds.state_names
    columns = Columns(**(vars(ds._columns) | new))
    return TrajectoryDataset._of(columns.freeze(), names)


def _moved(change: Floats, noise: NoiseModel) -> float:
    """Root mean square change of what is measured, in standard deviations of its noise."""
    m = len(noise.measurement)
    return float(np.sqrt(np.mean(change[:, :m] ** 2 / noise.measurement, axis=0).max()))


def round_learner(learner: Any) -> Any:
    """Unfitted learner of the rounds: of networks, one with a short training that goes on."""
    if not isinstance(learner, MLPEnsembleRegressor):
        return clone(learner)
    steps = _STEPS if learner.max_steps is None else min(_STEPS, learner.max_steps)
    chosen = {"n_members": 1, "probabilistic": False, "bootstrap": False, "early_stopping": False}
    budget = {"max_steps": steps, "max_epochs": None, "warm_start": True, "verbose": 0}
    return clone(learner).set_params(**chosen, **budget)


def _refit(model: Any, ds: TrajectoryDataset, learner: Any, groups: NDArray[Any] | None) -> Any:
    """Fit the learner of the model on other states, in the units of the first fit."""
    rows, targets = model.relabeler_.fit_resample(ds)
    episode = model.relabeler_.sample_indices_
    model.estimator_ = fit_learner(
        learner,
        model._scaled(rows),
        model._learning_targets(rows, targets)[0],
        weight=None,
        groups=None if groups is None else groups[episode],
    )
    return model.estimator_
