"""One-step models: the next state from state and action (or theta), rolled out."""

from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from trajlearn._sklearn import Interval, StrOptions
from trajlearn.dynamics._base import TwoDoorRegressor
from trajlearn.dynamics._dynamics import Prediction
from trajlearn.dynamics._learner import mixture, spread
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rolling import RollingEstimator
from trajlearn.dynamics._rollout import expected_step, roll_out, sampled_step
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler

__all__ = ["OneStepRegressor"]

Floats = NDArray[np.float64]


class OneStepRegressor(RollingEstimator):
    """One-step dynamics: (s_t, a_t) -> s_{t+1}, or closed loop (s_t, theta) -> s_{t+1}, rolled out.

    ``actions[t]`` takes s_t to s_{t+1}. A roll-out replays the logged actions, or lets a policy
    recompute them from the predicted states; with ``inputs="params"`` it needs neither. D, P, DE
    and PE of the paper are the choices ``n_members`` and ``probabilistic`` of the learner.

    The mean of a forecast averages the members at every step. Standard deviations and samples
    come from particles that carry the members' differences and noise along (see `propagation`).

    Parameters
    ----------
    estimator : regressor or None, default=None
        Any scikit-learn regressor; None: `MLPEnsembleRegressor` with batches of 128.
    relabeler : TransitionRelabeler or None, default=None
        None: ``TransitionRelabeler(inputs=inputs)``.
    scaler : transformer or None, default=None
        None: `BlockScaler`.
    inputs : {"action", "params"} or sequence of str, default="action"
        What the model sees beside the state, see `TransitionRelabeler`; "params" is the
        closed-loop variant. Ignored if `relabeler` is given.
    target : {"change", "state"}, default="change"
        Learn s_{t+1} - s_t, or s_{t+1} itself.
    policy : callable or None, default=None
        ``policy(states (n, d_s), params (n, p), times (n,)) -> actions (n, d_a)``, for roll-outs.
    rollout_actions : {"auto", "logged", "policy"}, default="auto"
        "auto": the policy if there is one, else the logged actions.
    clip_states : float or None, default=None
        Clip predicted states to this multiple of the training range about its centre.
    propagation : {"tsinf", "ts1", "expectation"}, default="tsinf"
        Particles keep one member ("tsinf") or draw one at every step ("ts1"). "expectation":
        members are averaged at every step, and there is no uncertainty to ask for.
    n_particles : int, default=50
        Particles behind a standard deviation.
    error_score : float, default=-1e12
        Score of an episode whose forecast diverged.
    random_state : int, RandomState or None, default=None

    Attributes
    ----------
    estimator_, relabeler_, scaler_
        As fitted.
    layout_ : mapping from block to slice
    dt_ : float or None
        Time step of the training episodes; None where it is an input or unknown (rows).
    state_range_ : ndarray of shape (2, d_s)
        Least and greatest training states.
    n_features_in_ : int

    See Also
    --------
    TrajectoryRegressor : any horizon in one evaluation.

    References
    ----------
    K. Chua et al., "Deep Reinforcement Learning in a Handful of Trials using Probabilistic
    Dynamics Models", NeurIPS 2018 (TS1, TSinf).

    Examples
    --------
    A linear system is identified exactly, because actions are aligned:

    >>> import numpy as np
    >>> from sklearn.linear_model import LinearRegression
    >>> from trajlearn import OneStepRegressor, TrajectoryDataset
    >>> actions = np.random.default_rng(0).normal(size=(3, 20, 1))
    >>> states = np.zeros((3, 21, 1))
    >>> for t in range(20):
    ...     states[:, t + 1] = 0.9 * states[:, t] + 0.5 * actions[:, t]
    >>> ds = TrajectoryDataset.from_arrays(states, actions=actions)
    >>> model = OneStepRegressor(LinearRegression()).fit(ds)
    >>> bool(np.allclose(model.predict(ds), states[:, 1:]))
    True
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **TwoDoorRegressor._parameter_constraints,
        "inputs": [StrOptions({"action", "params"}), "array-like"],
        "target": [StrOptions({"change", "state"})],
        "policy": [callable, None],
        "rollout_actions": [StrOptions({"auto", "logged", "policy"})],
        "clip_states": [Interval(Real, 0, None, closed="neither"), None],
        "propagation": [StrOptions({"tsinf", "ts1", "expectation"})],
        "n_particles": [Interval(Integral, 2, None, closed="left")],
        "error_score": [Interval(Real, None, 0, closed="both")],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        relabeler: Any = None,
        scaler: Any = None,
        inputs: str | Sequence[str] = "action",
        target: str = "change",
        policy: Any = None,
        rollout_actions: str = "auto",
        clip_states: float | None = None,
        propagation: str = "tsinf",
        n_particles: int = 50,
        error_score: float = -1e12,
        random_state: Any = None,
    ) -> None:
        self.estimator = estimator
        self.relabeler = relabeler
        self.scaler = scaler
        self.inputs = inputs
        self.target = target
        self.policy = policy
        self.rollout_actions = rollout_actions
        self.clip_states = clip_states
        self.propagation = propagation
        self.n_particles = n_particles
        self.error_score = error_score
        self.random_state = random_state

    def _defaults(self) -> dict[str, Any]:
        return {
            "estimator": MLPEnsembleRegressor(batch_size=128),
            "relabeler": TransitionRelabeler(inputs=self.inputs),
            "scaler": BlockScaler(),
        }

    # -- fitting --------------------------------------------------------------------------

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        if not hasattr(self.relabeler_, "dt_"):
            states = np.concatenate([rows[:, self.layout_["state"]], targets])
            self._learn_ranges(states, tuple(self.layout_.columns["state"]), np.inf)
            self.relabeler_.dt_ = None
        self.dt_ = self.relabeler_.dt_
        largest = np.abs(targets).max(axis=0)
        self.target_scale_ = spread(self._change(rows, targets), largest, weight)
        super()._fit_rows(rows, targets, weight, groups)

    def _fit_episodes(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        rows, targets = self.relabeler_.fit_resample(ds)
        self.layout_ = self.relabeler_.layout_
        # a model of one step knows no longest horizon
        self._learn_ranges(ds.states, ds.state_names, np.inf)
        episode = self.relabeler_.sample_indices_
        self._fit_rows(
            rows,
            targets,
            None if weight is None else weight[episode],
            None if groups is None else groups[episode],
        )

    # -- forecasting ----------------------------------------------------------------------

    def _forecast(
        self,
        query: Query,
        *,
        actions: str,
        policy: Any,
        return_std: bool,
        n_samples: int | None,
        rng: np.random.Generator,
    ) -> Prediction:
        source, policy = self._source(query.ds, actions, policy)
        self._check_time_step(query.ds)
        moments = self._moments()
        initial, n_steps = query.initial_states, query.n_steps
        mean = roll_out(
            initial,
            n_steps,
            self._input_rows(query, source, policy, copies=1),
            expected_step(moments),
            self._limits(),
        )
        prediction = Prediction(mean, actions=source)
        n_paths = max(n_samples or 0, self.n_particles if return_std else 0)
        if not n_paths:
            return prediction
        self._check_uncertainty(moments, query)
        member = None
        n_members = getattr(self.estimator_, "n_members", 1)
        if self.propagation == "tsinf":
            member = np.repeat(rng.permutation(np.arange(n_paths) % n_members), len(query))
        paths = roll_out(
            np.tile(initial, (n_paths, 1)),
            n_steps,
            self._input_rows(query, source, policy, copies=n_paths),
            sampled_step(moments, member, rng),
            self._limits(),
        ).reshape(n_paths, *mean.shape)
        if return_std:
            with np.errstate(invalid="ignore"):
                std = paths.std(axis=0)
            prediction.std = np.where(np.isinf(paths).any(axis=0), np.inf, std)
        if n_samples:
            prediction.samples = paths[:n_samples].copy()
        return prediction

    def _check_uncertainty(self, moments: Any, query: Query) -> None:
        if self.propagation == "expectation":
            raise ValueError(
                'propagation="expectation" carries no uncertainty: choose "tsinf" or "ts1" for '
                "return_std= or n_samples=."
            )
        width = self.layout_.width
        means, variances = moments(np.zeros((1, width)))
        mixture(means, variances, self.estimator_)
