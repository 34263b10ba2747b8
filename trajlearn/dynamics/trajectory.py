"""Trajectory-based models: the state after a horizon in one evaluation."""

from numbers import Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from trajlearn._sklearn import HasMethods, Interval, StrOptions
from trajlearn.dynamics._base import TwoDoorRegressor
from trajlearn.dynamics._dynamics import DynamicsEstimator
from trajlearn.dynamics._forecaster import Prediction, Request
from trajlearn.dynamics._learner import mixture, required, spread, takes_weights
from trajlearn.dynamics._query import Query, make_query
from trajlearn.dynamics._uncertainty.correlated_noise import correlated_noise, correlation_time
from trajlearn.dynamics.horizon import HorizonFeatures
from trajlearn.dynamics.phase import PhaseFeatures
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors._prediction import mean_of_members
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import SubtrajectoryRelabeler, TrajectoryDataset
from trajlearn.trajectories._columns import runs
from trajlearn.trajectories._layout import Layout
from trajlearn.trajectories._pairs import Stretches
from trajlearn.trajectories.times import median_step

__all__ = ["TrajectoryRegressor"]

Floats = NDArray[np.float64]

# rows that fix the scalers where the learner gets fresh ones at every step
_SCALER_ROWS = 16_384
# rows predicted at once where the horizons differ between starts
_CHUNK_ROWS = 8_192
# training episodes whose residuals give the correlation of a sampled path
_RESIDUAL_EPISODES = 32


class TrajectoryRegressor(DynamicsEstimator):
    r"""Trajectory-based dynamics: (s_t, h, theta) -> s_{t+h} in one evaluation.

    The controller enters by its parameters theta, not by its actions, so that nothing is rolled
    out and errors do not compound. Trained on all sub-trajectories of the episodes:

    .. math:: s_{t+h} = s_t + g(h)\,\sigma \odot f(s_t, h, \theta),

    with the gate :math:`g(h) = 1 - e^{-h / \tau}`, which makes short horizons exact, and the scale
    :math:`\sigma` of the change of state. T, TP, TE and TPE of the paper are the choices
    ``n_members`` and ``probabilistic`` of the learner.

    Where a reference drives the plant, or all episodes do much the same, a prediction relative
    to a `baseline` b(t) of that motion learns what is left of it, the deviation d = s - b:

    .. math:: s_{t+h} = b_{t+h} + (1 - g(h))\,d_t + g(h)\,\sigma \odot f(d_t, h, \theta, \dots).

    References (at t, at knots and at t + h), the phase and the context are inputs where the
    episodes have them.

    Parameters
    ----------
    estimator : regressor or None, default=None
        Any scikit-learn regressor; None: ``MLPEnsembleRegressor(probabilistic="separate")``,
        whose variance is that of training residuals, hence too small with few episodes: calibrate.
    relabeler : SubtrajectoryRelabeler or None, default=None
        None: ``SubtrajectoryRelabeler(starts="early", horizons="mixture", n_knots=3)``.
    scaler : transformer or None, default=None
        None: `BlockScaler` with `HorizonFeatures` for the horizon and `PhaseFeatures` for the
        phase.
    baseline : {"state", "mean", None}, callable or forecaster, default="state"
        What a prediction is relative to. "state": the state at the start. None: nothing, as in
        the paper. A callable ``state_of(references (m, d_r)) -> (m, d_s)``: the reference, see
        `ReferenceForecaster`. "mean": the mean episode at that phase, see
        `MeanEpisodeForecaster`. An estimator with ``fit(ds)`` and ``predict(ds) -> Forecast``:
        its forecast from the first state of the episode (so that it matters where an episode
        begins), to the end of the log. One that learns is fitted inside, and predicts each
        training episode out of fold; ``FrozenEstimator(fitted)`` is taken as it is.
    gate : float or None, default=0.05
        Time constant of the gate as a fraction of the longest horizon; None for no gate.
    fresh_batches : bool, default=True
        Draw new sub-trajectories for every batch if the learner has `fit_stream`; otherwise (and
        for other learners) fit on one draw of the relabeler.
    error_score : float, default=-1e12
        Score of an episode whose forecast diverged.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    estimator_, relabeler_, scaler_
        As fitted.
    baseline_ : forecaster or None
    layout_ : mapping from block to slice
    max_horizon_ : float
        Longest horizon in training, as a time.
    dt_ : float or None
        Median time step of the training episodes; None for rows.
    state_range_ : ndarray of shape (2, d_s)
        Least and greatest training states.
    noise_time_ : ndarray of shape (d_s,)
        Correlation time of the residuals along a trajectory, for sampled paths.
    n_features_in_ : int

    See Also
    --------
    OneStepRegressor : models of one step, rolled out.
    CalibratedForecaster : intervals that hold on new episodes.

    References
    ----------
    N. Lambert et al., "Learning Accurate Long-term Dynamics for Model-based Reinforcement
    Learning", CDC 2021.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset, TrajectoryRegressor
    >>> rate = np.linspace(0.5, 1.5, 20)  # s' = -theta s, from s_0 = 1
    >>> states = np.exp(-rate[:, None] * 0.1 * np.arange(31))[..., None]
    >>> ds = TrajectoryDataset.from_arrays(states, params=rate[:, None], dt=0.1)
    >>> model = TrajectoryRegressor(random_state=0).set_params(estimator__max_steps=300).fit(ds)
    >>> forecast = model.predict_trajectory([1.0], params=[0.77], horizons=[1.0, 2.5])
    >>> bool(np.abs(forecast.mean[0, :, 0] - np.exp([-0.77, -0.77 * 2.5])).max() < 0.02)
    True
    """

    _needs_constant_params = True
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **TwoDoorRegressor._parameter_constraints,
        "baseline": [StrOptions({"state", "mean"}), callable, HasMethods(["predict"]), None],
        "gate": [Interval(Real, 0, None, closed="neither"), None],
        "fresh_batches": ["boolean"],
        "error_score": [Interval(Real, None, 0, closed="both")],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        relabeler: Any = None,
        scaler: Any = None,
        baseline: Any = "state",
        gate: float | None = 0.05,
        fresh_batches: bool = True,
        error_score: float = -1e12,
        random_state: Any = None,
    ) -> None:
        self.estimator = estimator
        self.relabeler = relabeler
        self.scaler = scaler
        self.baseline = baseline
        self.gate = gate
        self.fresh_batches = fresh_batches
        self.error_score = error_score
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {
            "estimator": MLPEnsembleRegressor(probabilistic="separate"),
            "relabeler": SubtrajectoryRelabeler(starts="early", horizons="mixture", n_knots=3),
            "scaler": BlockScaler(horizon=HorizonFeatures(), phase=PhaseFeatures()),
        }

    def _layout_of_rows(self, n_features: int, n_targets: int) -> Layout:
        if n_features <= n_targets:
            raise ValueError(
                f"rows have n_features = {n_features}, but {n_targets} target(s) need at least "
                f"{n_targets + 1} columns: the {n_targets} state(s), the horizon, then params."
            )
        return Layout.of_rows(n_features, n_targets, ("horizon", "params"))

    # -- fitting --------------------------------------------------------------------------

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        horizons = np.abs(rows[:, self.layout_["horizon"]])
        states = np.concatenate([rows[:, self.layout_["state"]], targets])
        names = tuple(self.layout_.columns["state"])
        self._learn_ranges(states, names, float(horizons.max()))
        self.noise_time_ = np.full(targets.shape[1], np.inf)
        self.dt_: float | None = None
        self._learn_scale(rows, targets, weight)
        super()._fit_rows(rows, targets, weight, groups)

    def _fit_states(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        relabeler = self.relabeler_.fit(ds)
        self.layout_ = relabeler.layout_
        self.max_horizon_ = self._longest_horizon(ds)
        self.dt_ = median_step(ds)
        if self.fresh_batches and hasattr(self.estimator_, "fit_stream"):
            self._fit_stream(ds, weight)
        else:
            rows, targets = relabeler.fit_resample(ds)
            episode = relabeler.sample_indices_
            by_row = None if weight is None else weight[episode]
            self._learn_scale(rows, targets, by_row)
            labels = None if groups is None else groups[episode]
            super()._fit_rows(rows, targets, by_row, labels)
        self._learn_noise_time(ds)

    def _longest_horizon(self, ds: TrajectoryDataset) -> float:
        """Longest time between two states that the relabeler may pair."""
        stretches = Stretches.of(ds)
        most = getattr(self.relabeler_, "max_horizon", None)
        steps = stretches.n_steps if most is None else np.minimum(stretches.n_steps, most)
        n_starts = stretches.n_steps - steps + 1
        first = runs(stretches.first_row, n_starts)
        last = first + np.repeat(steps, n_starts)
        return float((ds.times[last] - ds.times[first]).max())

    def _fit_stream(self, ds: TrajectoryDataset, weight: Floats | None) -> None:
        """Fresh sub-trajectories for every batch."""
        learner = self.estimator_
        fixed = ("early_stopping", "bootstrap", "max_epochs")
        if asked := [name for name in fixed if getattr(learner, name, None)]:
            raise ValueError(
                f"{', '.join(asked)} of the learner needs rows that stay the same from batch to "
                "batch: set fresh_batches=False."
            )
        draw_pairs = self.relabeler_.sampler(ds)
        rows, targets, episode = draw_pairs(_SCALER_ROWS, self._rng)
        by_row = None if weight is None else weight[episode]
        self._learn_scale(rows, targets, by_row)
        self._fit_scaler(rows, by_row)

        def draw(n: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats | None]:
            rows, targets, episode = draw_pairs(n, rng)
            z, factor = self._learning_targets(rows, targets)
            if weight is not None:
                factor = weight[episode] if factor is None else factor * weight[episode]
            return self._scaled(rows), z, factor

        self.estimator_ = self.estimator_.fit_stream(draw, n_rows=self.relabeler_.n_pairs(ds))

    def _learn_scale(self, rows: Floats, targets: Floats, weight: Floats | None) -> None:
        """Scale of what is predicted: the state, its change, or its deviation from the baseline."""
        largest = np.abs(targets).max(axis=0)
        # the fitted model goes by what it was fitted with, whatever the parameters become
        self._gate_time = self.gate if self.baseline is not None else None
        self._anchored = self.baseline is not None
        change = self._anchored and self.baseline_ is None
        start = rows[:, self.layout_["state"]] if change else 0.0
        self.target_scale_ = spread(targets - start, largest, weight)

    def _anchor(self, start: Floats, gate: Floats) -> Floats | float:
        """Where a prediction is while the gate is shut: at the start, or leaving it."""
        if not self._anchored:
            return 0.0
        return start if self.baseline_ is None else (1 - gate) * start

    def _gate(self, rows: Floats) -> Floats:
        """g(h) of each row (n, 1); not quite 0 at h = 0, since targets are divided by it."""
        if self._gate_time is None:
            return np.ones((len(rows), 1))
        horizon = np.abs(rows[:, self.layout_["horizon"]])
        gate = -np.expm1(-horizon / (self._gate_time * (self.max_horizon_ or 1.0)))
        return np.maximum(gate, 1e-3)

    def _learning_targets(self, rows: Floats, targets: Floats) -> tuple[Floats, Floats | None]:
        gate = self._gate(rows)
        if not takes_weights(self.estimator_):
            gate = np.ones_like(gate)
        self._gated = takes_weights(self.estimator_)
        z = (targets - self._anchor(rows[:, self.layout_["state"]], gate)) / (
            gate * self.target_scale_
        )
        # the squared error of the state, not of z
        return z, gate[:, 0] ** 2 if (gate != 1).any() else None

    def _restore(self, rows: Floats, means: Floats, variances: Floats) -> tuple[Floats, Floats]:
        gate = self._gate(rows) if self._gated else np.ones((len(rows), 1))
        scale = gate * self.target_scale_
        anchor = self._anchor(rows[:, self.layout_["state"]], gate)
        return anchor + scale * means, scale**2 * variances

    def _learn_noise_time(self, ds: TrajectoryDataset) -> None:
        """Correlation time of standardised residuals along training episodes, by state."""
        few = ds[:_RESIDUAL_EPISODES]
        query, _ = make_query(few, 0, None, within_log=True, within_stretch=True)
        means, variances = self._at(query)
        truth = query.future(few.states, steps=False)[:, 1:]
        residual = np.where(query.known()[..., None], truth - mean_of_members(means), 0.0)
        if variances is not None:
            _, variance = mixture(means, variances, self.estimator_)
            # some learners claim to be certain
            floor = np.maximum(1e-6 * (residual**2).mean(axis=(0, 1)), 1e-300)
            residual = residual / np.sqrt(np.maximum(variance, floor))
        self.noise_time_ = correlation_time(residual, median_step(few))

    # -- forecasting ----------------------------------------------------------------------

    def _reads_logged_future(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        return "references" in self.layout_

    def _forecast_states(self, query: Query, request: Request) -> Prediction:
        spread = bool(request.return_std or request.n_samples)
        means, variances = self._at(query, means_only=not spread)
        prediction = Prediction(mean_of_members(means))
        if spread:
            variances = required(variances, self.estimator_)
            std = np.sqrt(mixture(means, variances, self.estimator_)[1])
            prediction.std = std if request.return_std else None
        if request.n_samples and variances is not None:
            prediction.samples = self._sample(
                query, means, variances, request.n_samples, request.rng
            )
        return prediction

    def _at(self, query: Query, *, means_only: bool = False) -> tuple[Floats, Floats | None]:
        """Means and variances (E, n, H, d_s) at every step of a query.

        `means_only` saves the variances where they take a network of their own.
        """
        horizons = np.where(query.known(), query.horizons, 0.0)
        n, n_steps = horizons.shape
        longest = horizons[np.argmax(query.lengths)]
        splits = (
            isinstance(self.estimator_, MLPEnsembleRegressor)
            and isinstance(self.scaler_, BlockScaler)
            and not {"references", "phase"} & set(self.layout_)
        )
        if splits and ((horizons == longest) | ~query.known()).all():
            return self._at_split_rows(query, np.arange(n), longest[None], means_only)
        at_some = self._at_split_rows if splits else self._at_rows
        per_chunk = max(_CHUNK_ROWS // n_steps, 1)
        means, variances = [], []
        for at in range(0, n, per_chunk):
            some = np.arange(at, min(at + per_chunk, n))
            mean, variance = at_some(query, some, horizons[some], means_only)
            means.append(mean)
            if variance is not None:
                variances.append(variance)
        joined = np.concatenate(variances, axis=1) if variances else None
        return np.concatenate(means, axis=1), joined

    def _at_rows(
        self, query: Query, some: NDArray[np.intp], horizons: Floats, means_only: bool
    ) -> tuple[Floats, Floats | None]:
        """Some starts at horizons (len(some), H) of their own, row by row."""
        n_steps = horizons.shape[1]
        ds, start = query.ds, query.rows[some]
        rows = self.relabeler_.rows(ds, some, start, start)
        rows = np.repeat(rows, n_steps, axis=0)
        rows[:, self.layout_["horizon"]] = horizons.reshape(-1, 1)
        if "phase" in self.layout_:
            begin = np.repeat(query.initial_times[some], n_steps)
            rows[:, self.layout_["phase"]] = self.relabeler_.phase_rows(
                ds, np.repeat(some, n_steps), begin, begin + horizons.ravel()
            )
        if "references" in self.layout_:
            last = ds.offsets[1:][some, None] - 1
            end = np.minimum(start[:, None] + np.arange(1, n_steps + 1), last)
            rows[:, self.layout_["references"]] = self.relabeler_.reference_rows(
                ds, np.repeat(start, n_steps), end.ravel()
            )
        means, variances = self._moments(means_only=means_only)(rows)
        shape = (len(means), len(some), n_steps, means.shape[-1])
        return means.reshape(shape), None if variances is None else variances.reshape(shape)

    def _at_split_rows(
        self, query: Query, some: NDArray[np.intp], horizons: Floats, means_only: bool
    ) -> tuple[Floats, Floats | None]:
        """Some starts at horizons (len(some), H), or (1, H) for all: the first layer is split.

        Its products with starts and with horizons are computed apart. So also where horizons
        differ and nothing is saved: an episode gets the same bits alone as among others.
        """
        start = query.rows[some]
        left = self.relabeler_.rows(query.ds, some, start, start)
        right = np.repeat(left[:1], horizons.size, axis=0)
        right[:, self.layout_["horizon"]] = horizons.reshape(-1, 1)
        shape = (len(some), horizons.shape[1])
        which = np.arange(horizons.size).reshape(horizons.shape)
        columns = self.scaler_.block_columns_["horizon"]
        others = np.setdiff1d(np.arange(self.estimator_.n_features_in_), columns)
        outputs = self.estimator_.predictor(means_only=means_only).product(
            self._scaled(left)[:, others],
            self._scaled(right)[:, columns],
            (others, columns),
            (np.repeat(np.arange(len(some)), shape[1]), np.broadcast_to(which, shape).ravel()),
        )
        full = (len(outputs), *shape, len(self.target_scale_))
        gate = self._gate(right) if self._gated else np.ones((len(right), 1))
        gate = gate.reshape(*horizons.shape, 1)
        scale = gate * self.target_scale_
        anchor = self._anchor(query.initial_states[some, None], gate)
        if means_only:
            return anchor + scale * outputs[..., : full[-1]].reshape(full), None
        means, variances = self.estimator_.moments(outputs)
        return anchor + scale * means.reshape(full), scale**2 * variances.reshape(full)

    def _looked_at(self, grid: Floats, chosen: NDArray[np.intp]) -> tuple[Floats, NDArray[np.intp]]:
        n_knots = getattr(self.relabeler_, "n_knots", 0)
        parts = np.arange(1, n_knots + 2) / (n_knots + 1)
        times = np.unique(np.outer(grid, parts))
        return times, np.searchsorted(times, grid)[chosen]

    def _sample(
        self,
        query: Query,
        means: Floats,
        variances: Floats,
        n_samples: int,
        rng: np.random.Generator,
    ) -> Floats:
        """Whole trajectories: one member and one correlated noise path each."""
        member = rng.permutation(np.arange(n_samples) % len(means))
        times = np.concatenate([query.initial_times[:, None], query.times], axis=1)
        step = np.nan_to_num(np.diff(times, axis=1), nan=0.0)
        noise = correlated_noise(rng, n_samples, step, self.noise_time_)
        return means[member] + np.sqrt(variances[member]) * noise
