"""Recurrent models: the next state from all states and actions so far, rolled out."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajlearn._sklearn import Interval, StrOptions, fit_context
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._recurrent import Stepper
from trajlearn.dynamics._rollouts.rolling import RollingEstimator
from trajlearn.dynamics._rollouts.rollout import Step
from trajlearn.dynamics._sequence import SequenceLearner
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler

__all__ = ["LSTMRegressor"]

Floats = NDArray[np.float64]


class LSTMRegressor(RollingEstimator):
    r"""Recurrent dynamics: (s_0, a_0, ..., s_t, a_t) -> s_{t+1} with an LSTM, rolled out.

    The network carries a memory along an episode, so that it can infer what a single state does
    not show: a velocity that is not logged, a payload, a delay. It is trained with teacher
    forcing on whole episodes, in padded batches with a mask. A forecast first reads the history
    ``states[:start + 1]``, ``actions[:start]`` into the memory, then runs freely on its own
    predictions, as `OneStepRegressor` does.

    A plain row is a sequence of length one: it has no memory.

    Parameters
    ----------
    hidden_size : int, default=64
        Hidden units of each layer.
    n_layers : int, default=1
    probabilistic : bool, default=False
        Predict a mean and a variance for every step and train on the Gaussian likelihood
        (beta-NLL with beta = 0.5). Otherwise train on the squared error; the variance is then
        that of the training residuals under teacher forcing.
    learning_rate : float, default=2e-2
        Peak rate of the schedule.
    schedule : {"one-cycle", "constant"}, default="one-cycle"
        "one-cycle": a tenth of the steps warm-up, then a cosine down to zero.
    batch_size : int, default=8
        Episodes a gradient step; rows, where it is fitted on rows.
    max_steps : int or None, default=None
        Gradient steps. None: ``12 * n ** 0.55`` for n transitions, between 60 and 2,500.
    max_epochs : int or None, default=None
        Budget in passes over the episodes instead of steps.
    weight_decay : float, default=0.0
        Decoupled (AdamW), on weights only.
    window : int or None, default=None
        Train on a random stretch of at most that many steps of each episode; None takes all.
    relabeler : TransitionRelabeler or None, default=None
        None: ``TransitionRelabeler(inputs=inputs)``. It must keep every step.
    scaler : transformer or None, default=None
        None: `BlockScaler`.
    inputs : {"action", "params"} or sequence of str, default="action"
        What the model sees beside the state, see `TransitionRelabeler`. Ignored if `relabeler`
        is given.
    target : {"change", "state"}, default="change"
        Learn s_{t+1} - s_t, or s_{t+1} itself.
    baseline : {"mean", None}, callable or forecaster, default=None
        What states are relative to, as in `TrajectoryRegressor`: a callable of the references
        makes it a model of the tracking error. The references (for another baseline, its states)
        have to be among the inputs, as they are with ``inputs="params"``. A policy still gets
        the states themselves; `clip_states` is about the deviation.
    policy : callable, "clone" or None, default=None
        ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``, for roll-outs;
        "clone" learns it from the logged actions, as in `OneStepRegressor`.
    policy_estimator : regressor or None, default=None
        What learns the policy from scaled rows. None: `ControlLawRegressor`.
    rollout_actions : {"auto", "logged", "policy"}, default="auto"
        "auto": the policy if there is one, else the logged actions.
    clip_states : float or None, default=None
        Clip predicted states to this multiple of the training range about its centre.
    n_particles : int, default=50
        Particles behind a standard deviation, each with a memory and noise of its own.
    device : str, default="cpu"
    error_score : float, default=-1e12
        Score of an episode whose forecast diverged.
    random_state : int, RandomState or None, default=None
    verbose : int, default=0
        1 shows a progress bar.

    Attributes
    ----------
    estimator_ : learner of sequences
        Its ``weights_`` are arrays under the names that `torch.nn.LSTM` gives them; also
        ``n_steps_``, ``loss_curve_`` and ``residual_std_`` (in units of `target_scale_`).
    relabeler_, scaler_
        As fitted.
    layout_ : mapping from block to slice
    target_scale_ : ndarray of shape (d_s,)
    dt_ : float or None
        Time step of the training episodes; None where it is an input or unknown (rows).
    state_range_ : ndarray of shape (2, d_s)
        Least and greatest training states.
    baseline_ : forecaster or None
    policy_ : callable
        The cloned policy, with ``policy="clone"``.
    n_features_in_ : int

    See Also
    --------
    OneStepRegressor : without memory; the better choice where the logged state says it all.

    References
    ----------
    S. Hochreiter and J. Schmidhuber, "Long Short-Term Memory", Neural Computation 1997.
    M. Seitzer et al., "On the Pitfalls of Heteroscedastic Uncertainty Estimation with
    Probabilistic Neural Networks", ICLR 2022 (beta-NLL).

    Examples
    --------
    A mass whose velocity is not logged: one position says nothing, the history does.

    >>> import numpy as np
    >>> from trajlearn import LSTMRegressor, TrajectoryDataset
    >>> rng, t = np.random.default_rng(0), np.arange(21)
    >>> states = rng.normal(size=(40, 1, 1)) + rng.normal(size=(40, 1, 1)) * 0.1 * t[:, None]
    >>> ds = TrajectoryDataset.from_arrays(states)
    >>> model = LSTMRegressor(inputs=(), max_steps=300, random_state=0).fit(ds)
    >>> blind = np.abs(model.predict(ds, start=0, horizon=10).mean[:, 9] - states[:, 10]).mean()
    >>> seen = np.abs(model.predict(ds, start=5, horizon=10).mean[:, 9] - states[:, 15]).mean()
    >>> bool(seen < 0.3 * blind)
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **{
            name: allowed
            for name, allowed in RollingEstimator._parameter_constraints.items()
            if name != "estimator"
        },
        "hidden_size": [Interval(Integral, 1, None, closed="left")],
        "n_layers": [Interval(Integral, 1, None, closed="left")],
        "probabilistic": ["boolean"],
        "learning_rate": [Interval(Real, 0, None, closed="neither")],
        "schedule": [StrOptions({"one-cycle", "constant"})],
        "batch_size": [Interval(Integral, 1, None, closed="left")],
        "max_steps": [Interval(Integral, 1, None, closed="left"), None],
        "max_epochs": [Interval(Integral, 1, None, closed="left"), None],
        "weight_decay": [Interval(Real, 0, None, closed="left")],
        "window": [Interval(Integral, 1, None, closed="left"), None],
        "device": [str],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        *,
        hidden_size: int = 64,
        n_layers: int = 1,
        probabilistic: bool = False,
        learning_rate: float = 2e-2,
        schedule: str = "one-cycle",
        batch_size: int = 8,
        max_steps: int | None = None,
        max_epochs: int | None = None,
        weight_decay: float = 0.0,
        window: int | None = None,
        relabeler: Any = None,
        scaler: Any = None,
        inputs: str | Sequence[str] = "action",
        target: str = "change",
        baseline: Any = None,
        policy: Any = None,
        policy_estimator: Any = None,
        rollout_actions: str = "auto",
        clip_states: float | None = None,
        n_particles: int = 50,
        device: str = "cpu",
        error_score: float = -1e12,
        random_state: Any = None,
        verbose: int = 0,
    ) -> None:
        self.hidden_size = hidden_size
        self.n_layers = n_layers
        self.probabilistic = probabilistic
        self.learning_rate = learning_rate
        self.schedule = schedule
        self.batch_size = batch_size
        self.max_steps = max_steps
        self.max_epochs = max_epochs
        self.weight_decay = weight_decay
        self.window = window
        self.relabeler = relabeler
        self.scaler = scaler
        self.inputs = inputs
        self.target = target
        self.baseline = baseline
        self.policy = policy
        self.policy_estimator = policy_estimator
        self.rollout_actions = rollout_actions
        self.clip_states = clip_states
        self.n_particles = n_particles
        self.device = device
        self.error_score = error_score
        self.random_state = random_state
        self.verbose = verbose

    def _defaults(self) -> dict[str, Any]:
        # its seed comes from this estimator's own, as every learner's does
        own = (name for name in SequenceLearner().get_params() if name != "random_state")
        learner = {name: getattr(self, name) for name in own}
        return {
            "estimator": SequenceLearner(**learner),
            "relabeler": TransitionRelabeler(inputs=self.inputs),
            "scaler": BlockScaler(),
            **self._default_policy(),
        }

    # -- fitting --------------------------------------------------------------------------

    @fit_context(prefer_skip_nested_validation=True)
    def fit(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> Self:
        """Fit on episodes, or on rows with targets.

        Parameters
        ----------
        X : TrajectoryDataset, list of Trajectory, or array-like of shape (n, n_features)
        y : array-like of shape (n,) or (n, n_targets)
            Targets of rows; omitted for episodes.
        groups : array-like of shape (n,), optional
            Ignored: nothing is held out.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            For invalid episodes or rows, a relabeler that leaves steps out, an absent device,
            training that diverges.
        """
        return self._fit(X, y, None, groups)

    def _fit_states(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        max_rows, n_steps = getattr(self.relabeler_, "max_rows", None), int(ds.lengths.sum())
        if max_rows is not None and max_rows < n_steps:
            raise ValueError(
                f"relabeler has max_rows={max_rows}, but a sequence needs every step (there are "
                f"{n_steps}); use max_rows=None, and fewer episodes or window= to save time."
            )
        super()._fit_states(ds, None, None)

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        # the learner's groups are its sequences: episodes, or single rows
        sequence = getattr(self.relabeler_, "sample_indices_", None)
        super()._fit_rows(rows, targets, None, sequence)

    # -- forecasting ----------------------------------------------------------------------

    def _step(self, query: Query, copies: int, rng: np.random.Generator | None) -> Step:
        learner, memory = self.estimator_, self._after_history(query).repeated(copies)

        def step(rows: Floats, k: int) -> Floats:
            mean, variance = learner.moments(memory.step(self._scaled(rows)))
            mean, variance = self._restore(rows, mean, variance)
            if rng is None:
                return mean
            return mean + np.sqrt(variance) * rng.standard_normal(mean.shape)

        return step

    def _after_history(self, query: Query) -> Stepper:
        """Memory of each episode after its transitions before the start."""
        ds, start = query.ds, query.start
        memory = self.estimator_.stepper(len(query))
        if "action" in self.layout_ and start.any() and ds.actions is not None:
            self._check_action_width(ds)
        for k in range(start.max()):
            episode = np.flatnonzero(start > k)
            begin = ds.offsets[episode] + k
            own = self.relabeler_.rows(ds, episode, begin, begin + 1)
            # episodes that have begun wait; their rows must be possible ones all the same
            rows = np.tile(own[0], (len(query), 1))
            rows[episode] = own
            memory.step(self._scaled(rows), start > k)
        return memory
