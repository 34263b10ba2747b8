"""One-step models: the next state from state and action (or theta), rolled out."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from trajlearn._sklearn import StrOptions
from trajlearn.dynamics._learner import required
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rolling import RollingEstimator
from trajlearn.dynamics._rollout import Floats, Step, expected_step, sampled_step
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.regressors.mlp import MLPEnsembleRegressor
from trajlearn.trajectories import TransitionRelabeler

__all__ = ["OneStepRegressor"]


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
    baseline : {"mean", None}, callable or forecaster, default=None
        What states are relative to, as in `TrajectoryRegressor`: a callable of the references
        makes it a model of the tracking error. The references (for another baseline, its states)
        have to be among the inputs, as they are with ``inputs="params"``. A policy still gets
        the states themselves; `clip_states` is about the deviation.
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
    baseline_ : forecaster or None
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
        **RollingEstimator._parameter_constraints,
        "propagation": [StrOptions({"tsinf", "ts1", "expectation"})],
    }

    def __init__(
        self,
        estimator: Any = None,
        *,
        relabeler: Any = None,
        scaler: Any = None,
        inputs: str | Sequence[str] = "action",
        target: str = "change",
        baseline: Any = None,
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
        self.baseline = baseline
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

    # -- forecasting ----------------------------------------------------------------------

    def _step(self, query: Query, copies: int, rng: np.random.Generator | None) -> Step:
        moments = self._moments()
        if rng is None:
            return expected_step(moments)
        if self.propagation == "expectation":
            raise ValueError(
                'propagation="expectation" carries no uncertainty: choose "tsinf" or "ts1" for '
                "return_std= or n_samples=."
            )

        def spread(rows: Floats) -> tuple[Floats, Floats]:
            means, variances = moments(rows)
            return means, required(variances, self.estimator_)

        member = None
        n_members = getattr(self.estimator_, "n_members", 1)
        if self.propagation == "tsinf":
            member = np.repeat(rng.permutation(np.arange(copies) % n_members), len(query))
        return sampled_step(spread, member, rng)
