"""Kalman filtering and smoothing of the states of a dataset."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from trajlearn._sklearn import Interval, StrOptions, fit_context
from trajlearn.trajectories._kalman_blocks import (
    Block,
    FittedBlock,
    estimate,
    fit_block,
    training_grid,
)
from trajlearn.trajectories._kalman_checks import (
    contradiction,
    warn_contradicting,
    warn_correlated,
    warn_filtered,
    warn_misfit,
    warn_wrapped,
)
from trajlearn.trajectories._kalman_choices import (
    MODELS,
    check_process_noise,
    given_noise,
    kinematic_blocks,
    known_states,
    state_space_block,
)
from trajlearn.trajectories._kalman_fit import Signals
from trajlearn.trajectories._kalman_models import Kinematic, StateSpaceModel
from trajlearn.trajectories._state_space import Grid, filtered, smoothed
from trajlearn.trajectories._transformer import DatasetTransformer
from trajlearn.trajectories.coerce import as_dataset
from trajlearn.trajectories.dataset import TrajectoryDataset

__all__ = ["KalmanSmoother", "StateSpaceModel"]

Floats = NDArray[np.float64]


class KalmanSmoother(DatasetTransformer):
    """Estimate states from noisy measurements of them: a transformer from dataset to dataset.

    `fit_transform` smooths (Rauch, Tung and Striebel): every state is estimated from all of its
    episode, for training targets. `transform` filters: a state is estimated from the
    measurements up to its time and nothing later, so that a forecast from it is honest. Before
    a dynamics estimator in a `Pipeline` that is what fitting and predicting call. The raw states
    stay in `observed`, and scores compare with those.

    What `fit_transform` returns has seen the future (`TrajectoryDataset.hindsight`; forecasts
    from it warn): train on it, but never smooth before splitting into training and test, and
    test on raw episodes through the `Pipeline` or on `transform` of them.

    Each state has a filter of its own, whose velocity (or acceleration) drifts by white noise;
    `velocities` names states that are measured velocities of others, and a `StateSpaceModel`
    treats several states together. Times may be irregular. Values are plain numbers: unwrap
    angles first.

    The variance of the noise and the spectral density of the drift maximise the exact likelihood
    of the innovations over (up to 128 stretches of 128 states of) the training episodes. An episode
    may begin anywhere: the first measurement is the first estimate. A velocity that was not
    measured begins with the mean that it has at the start of training episodes, and the
    covariance of all states in training about it; from two states on it is better and better.

    A model of motion knows nothing of actions: where states jump, change much from one sample to
    the next, or are known exactly but driven by noise, it takes motion for noise. `fit` warns
    where it sees that, not everywhere: compare with and without by cross-validation.

    Parameters
    ----------
    model : {"velocity", "acceleration", "auto"} or StateSpaceModel, default="velocity"
        What is nearly constant, or the likelier of the two for each filter, or a given linear
        model.
    states : sequence of str or None, default=None
        States to smooth; None: all. Others pass through.
    velocities : mapping from str to str or None, default=None
        State that is a position -> state that is its measured velocity: one filter for both.
    append_velocities : bool or sequence of str, default=False
        Append the estimated velocity of each of these states (True: of each that has none in
        `velocities`) as a new state ``d_<name>``.
    measurement_noise : float, mapping or None, default=None
        Standard deviation of the measurement noise, in the unit of the state: one, or by name.
        What is not given is estimated.
    process_noise : float, mapping or None, default=None
        Spectral density of the white noise that drives the velocity (unit^2 / time^3) or the
        acceleration (unit^2 / time^5); a factor of Q for a `StateSpaceModel` without R. By the
        name of the (position) state, and not with "auto". What is not given is estimated.
    training : {"smooth", "filter"}, default="smooth"
        What `fit_transform` returns: smoothed states, or filtered ones as `transform` does, such
        that training and test states have the same kind of error and nothing has seen the future.

    Attributes
    ----------
    state_names_ : tuple of str
        States in training.
    measurement_noise_ : dict from str to float
        Standard deviation by state; of a given R, its root diagonal.
    process_noise_ : dict from str to float
        By (position) state, or ``{"model": factor}`` for a `StateSpaceModel`.
    models_ : dict from str to str
        "velocity" or "acceleration" by (position) state; empty for a `StateSpaceModel`.
    initial_mean_, initial_covariance_ : dict from str to ndarray
        Of the first hidden state (position, velocity, ...), by the keys of `process_noise_`. The
        mean is 0 in what is measured, to which the first measurement is added; the covariance
        holds given that. Those of a `StateSpaceModel` that has them: as given.

    Warns
    -----
    SmoothingWarning
        In `fit`: if the noise of a state is far below its change between samples (noise-free, or
        filtered already); if smoothing moves it by more than its noise, or its innovations are
        correlated (states that jump or are driven by noise of their own, outputs of a filter);
        if it jumps by 2 pi; or if a velocity is not the derivative of its position.

    See Also
    --------
    TrajectoryDataset.observed : the raw states.

    References
    ----------
    Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", 2001, ch. 6 (white noise acceleration) and 8 (smoothing).

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import KalmanSmoother, TrajectoryDataset
    >>> true = np.cumsum(np.cumsum(np.random.default_rng(0).normal(size=(20, 80, 1)), 1), 1)
    >>> noisy = true + np.random.default_rng(1).normal(size=true.shape)
    >>> ds = TrajectoryDataset.from_arrays(noisy, state_names=["x"])
    >>> smoother = KalmanSmoother(append_velocities=True)
    >>> smooth = smoother.fit_transform(ds)
    >>> smooth.state_names
    ('x', 'd_x')
    >>> print(f"{smoother.measurement_noise_['x']:.1f}")
    1.0
    >>> raw, now = (np.std(x - true.ravel()) for x in (ds.states[:, 0], smooth.states[:, 0]))
    >>> bool(now < 0.75 * raw)
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "model": [StrOptions(set(MODELS)), StateSpaceModel],
        "states": ["array-like", None],
        "velocities": [Mapping, None],
        "append_velocities": ["boolean", "array-like"],
        "measurement_noise": [Interval(Real, 0, None, closed="neither"), Mapping, None],
        "process_noise": [Interval(Real, 0, None, closed="neither"), Mapping, None],
        "training": [StrOptions({"smooth", "filter"})],
    }

    def __init__(
        self,
        model: str | StateSpaceModel = "velocity",
        *,
        states: Sequence[str] | None = None,
        velocities: Mapping[str, str] | None = None,
        append_velocities: bool | Sequence[str] = False,
        measurement_noise: float | Mapping[str, float] | None = None,
        process_noise: float | Mapping[str, float] | None = None,
        training: str = "smooth",
    ) -> None:
        self.model = model
        self.states = states
        self.velocities = velocities
        self.append_velocities = append_velocities
        self.measurement_noise = measurement_noise
        self.process_noise = process_noise
        self.training = training

    # -- fitting --------------------------------------------------------------------------

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: Any, y: None = None) -> Self:
        """Estimate noise and the first hidden state.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If a name is unknown or used twice, a given noise is not positive or goes with
            ``model="auto"``, or the episodes are too short to estimate noise from.
        """
        ds = as_dataset(X)
        check_process_noise(self.model, self.process_noise)
        self.state_names_ = ds.state_names
        names = known_states(self.states, "states", ds.state_names)
        choices = self._choices(names)
        sigma = given_noise(self.measurement_noise, "measurement_noise", names)
        keys = [self._key(choice[0]) for choice in choices]
        density = given_noise(self.process_noise, "process_noise", keys)
        if isinstance(self.model, StateSpaceModel) and self.model.R is not None:
            if sigma or density:
                raise ValueError("the model has Q and R: leave out the noise, or R.")
            # measured numbers are scaled to a variance of 1
            sigma, density = dict.fromkeys(names, 1.0), dict.fromkeys(keys, 1.0)
        grid = training_grid(ds)
        blocks: list[FittedBlock] = []
        for key, choice in zip(keys, choices, strict=True):
            measured = self._measured(choice[0])
            variance = np.array([sigma.get(name, np.nan) ** 2 for name in measured])
            # likelihoods of several models have to be of the same numbers
            how = {"skip": 3} if len(choice) > 1 else {}
            fitted = [
                fit_block(block, ds, grid, variance, density.get(key, np.nan), **how)
                for block in choice
            ]
            blocks.append(min(fitted, key=lambda block: block.noise.deviance))
        # filters of one model stand together and run together
        blocks.sort(key=lambda block: (len(block.columns), getattr(block.motion, "order", 0)))
        self._blocks = blocks
        self._describe()
        self._warn(ds, grid, estimated=[name for name in names if name not in sigma])
        return self

    def fit_transform(self, X: Any, y: None = None) -> TrajectoryDataset:
        """Fit, and estimate the states of the same episodes, as `training` says.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
        y : None

        Returns
        -------
        TrajectoryDataset
            With ``training="smooth"`` each state is estimated from the whole episode, and the
            dataset is marked so (`hindsight`).
        """
        self.fit(X)
        if self.training == "filter":
            return self.transform(X)
        ds = self._estimated(as_dataset(X), smoothed)
        return TrajectoryDataset._of(replace(ds._columns, hindsight=True), ds._names)

    def transform(self, X: Any) -> TrajectoryDataset:
        """Filter: each state estimated from the measurements up to it.

        Parameters
        ----------
        X : TrajectoryDataset or list of Trajectory
            With the states of the training episodes.

        Returns
        -------
        TrajectoryDataset
            Its columns in their order and units, then the estimated velocities; `observed` are
            the states of `X` (or its `observed`, if it has some).

        Raises
        ------
        ValueError
            If the states are not those of training.
        MixedSamplingError
            If F or Q of a given model is one matrix and the time step another than in training.
        """
        check_is_fitted(self, "measurement_noise_")
        return self._estimated(as_dataset(X), lambda bank, measured, _: filtered(bank, measured))

    def get_feature_names_out(self, input_features: Any = None) -> NDArray[Any]:
        """Names of the states of the transformed dataset.

        Parameters
        ----------
        input_features : None

        Returns
        -------
        ndarray of str
        """
        check_is_fitted(self, "measurement_noise_")
        return np.array([*self.state_names_, *self._appended()], dtype=object)

    # -- what is estimated ----------------------------------------------------------------

    def _choices(self, names: list[str]) -> list[list[Block]]:
        """The filters, each with the models to choose from."""
        if not isinstance(self.model, StateSpaceModel):
            pairs, append = self.velocities, self.append_velocities
            return kinematic_blocks(self.model, names, pairs, append, self.state_names_)
        if self.velocities or self.append_velocities is not False:
            raise ValueError(
                "velocities= and append_velocities= go with a model by name; a StateSpaceModel "
                "says in H and outputs= what is measured and appended."
            )
        return [[state_space_block(self.model, names, self.state_names_)]]

    def _measured(self, block: Block) -> list[str]:
        return [self.state_names_[column] for column in block.columns]

    def _key(self, block: Block) -> str:
        """What the filter goes by: its (position) state."""
        return "model" if isinstance(block.motion, StateSpaceModel) else self._measured(block)[0]

    def _describe(self) -> None:
        """Fill the public attributes."""
        ordered = sorted(self._blocks, key=lambda block: block.columns)
        self.measurement_noise_: dict[str, float] = {}
        for block in ordered:
            names = self._measured(block)
            self.measurement_noise_ |= dict(zip(names, block.sigma.tolist(), strict=True))
        by_key = {self._key(block): block for block in ordered}
        self.process_noise_ = {key: block.noise.intensity for key, block in by_key.items()}
        self.initial_mean_ = {key: block.start.mean for key, block in by_key.items()}
        self.initial_covariance_ = {k: block.start.covariance for k, block in by_key.items()}
        self.models_ = {
            key: "velocity" if block.motion.order == 1 else "acceleration"
            for key, block in by_key.items()
            if isinstance(block.motion, Kinematic)
        }

    def _warn(self, ds: TrajectoryDataset, grid: Grid, estimated: list[str]) -> None:
        names = list(self.measurement_noise_)
        columns = [ds.state_names.index(name) for name in names]
        states = ds.states[grid.rows][..., columns]
        steps = np.diff(states, axis=0)[grid.known[1:]]
        # what has been told of a state is not followed by its symptoms
        told = warn_wrapped(names, states[grid.known], steps)
        change = dict(zip(names, np.sqrt(np.mean(steps**2, axis=0)), strict=True))
        asked = [name for name in estimated if name not in told]
        noise = np.array([self.measurement_noise_[name] for name in asked])
        told += warn_filtered(asked, noise, np.array([change[name] for name in asked]))
        gaps, correlated = {}, {}
        for block in self._blocks:
            names = self._measured(block)
            moved = np.where(np.isin(names, told), 0.0, block.moved)
            told += warn_misfit(names, moved, block.sigma)
            following, later, n = block.correlated
            for i, name in enumerate(names):
                if name not in told:
                    correlated[name] = float(following[i]), float(later[i]), n
            if isinstance(block.motion, Kinematic) and block.motion.pair:
                gap = contradiction(Signals(ds.states[:, block.columns], grid, block.motion))
                if gap is not None:
                    gaps[names[0], names[1]] = gap
        warn_correlated(correlated)
        warn_contradicting(gaps)

    # -- the new dataset ------------------------------------------------------------------

    def _appended(self) -> list[str]:
        """New states, in the order of the states they belong to."""
        ordered = sorted(self._blocks, key=lambda block: block.columns)
        return [name for block in ordered for name in block.appended]

    def _estimated(self, ds: TrajectoryDataset, run: Any) -> TrajectoryDataset:
        if ds.state_names != self.state_names_:
            raise ValueError(
                f"the episodes have the states {list(ds.state_names)}, the smoother was fitted on "
                f"{list(self.state_names_)}."
            )
        appended = self._appended()
        taken = [name for name in appended if name in ds.state_names]
        if taken:
            raise ValueError(f"the episodes have states {taken} already; rename or drop them.")
        new: dict[str, Floats] = {}
        states = ds.states.copy()
        for block, values in zip(self._blocks, estimate(self._blocks, ds, run), strict=True):
            k = len(block.columns)
            states[:, block.columns] = values[:, :k]
            new |= dict(zip(block.appended, values[:, k:].T, strict=True))
        states = np.column_stack([states, *(new[name] for name in appended)])
        observed, names = ds.observed, ds.observed_names
        if observed is None:
            observed, names = ds.states, ds.state_names
        columns = replace(ds._columns, states=np.ascontiguousarray(states), observed=observed)
        return TrajectoryDataset._of(
            columns.freeze(),
            ds._names | {"states": (*ds.state_names, *appended), "observed": names},
        )
