"""What models of one step share: fitting, where actions come from, and forecasts by roll-outs."""

from abc import abstractmethod
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from trajlearn._sklearn import HasMethods, Interval, StrOptions
from trajlearn.dynamics._base import TwoDoorRegressor
from trajlearn.dynamics._dynamics import DynamicsEstimator
from trajlearn.dynamics._forecaster import DIVERGENCE_RANGES, Prediction, Request
from trajlearn.dynamics._learner import seeded, spread
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rollouts.cloned_policy import ClonedPolicy, clone_policy
from trajlearn.dynamics._rollouts.input_rows import input_rows
from trajlearn.dynamics._rollouts.noisy_sight import independent, paired
from trajlearn.dynamics._rollouts.rollout import InputRows, Limits, Step, roll_out
from trajlearn.dynamics.baselines import ReferenceForecaster
from trajlearn.exceptions import MissingFieldError, MixedSamplingError
from trajlearn.regressors.control_law import ControlLawRegressor
from trajlearn.trajectories import TrajectoryDataset
from trajlearn.trajectories._layout import Layout
from trajlearn.trajectories.times import uniform_step

__all__ = ["RollingEstimator"]

Floats = NDArray[np.float64]

# of the particles behind a mean
_SIGHT_SEED = 0


class RollingEstimator(DynamicsEstimator):
    """Estimator of the next state that is applied again and again."""

    inputs: str | Sequence[str]
    target: str
    policy: Any
    policy_estimator: Any
    policy_: Any
    rollout_actions: str
    clip_states: float | None
    n_particles: int

    _rolls_out = True
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **TwoDoorRegressor._parameter_constraints,
        "inputs": [StrOptions({"action", "params"}), "array-like"],
        "target": [StrOptions({"change", "state"})],
        "baseline": [StrOptions({"mean"}), callable, HasMethods(["predict"]), None],
        "policy": [callable, StrOptions({"clone"}), None],
        "policy_estimator": [HasMethods(["fit", "predict"]), None],
        "rollout_actions": [StrOptions({"auto", "logged", "policy"})],
        "clip_states": [Interval(Real, 0, None, closed="neither"), None],
        "n_particles": [Interval(Integral, 2, None, closed="left")],
        "error_score": [Interval(Real, None, 0, closed="both")],
    }

    @abstractmethod
    def _step(self, query: Query, copies: int, rng: np.random.Generator | None) -> Step:
        """Step function of a roll-out: of the mean, or of `copies` particles a start with noise.

        Parameters
        ----------
        query : Query
        copies : int
            Particle i of start j is row ``i * len(query) + j``.
        rng : Generator or None
            None asks for the mean, and one copy.
        """

    # -- rows -----------------------------------------------------------------------------

    def _layout_of_rows(self, n_features: int, n_targets: int) -> Layout:
        if n_features < n_targets:
            raise ValueError(
                f"rows have n_features = {n_features}, but {n_targets} target(s) need at least "
                f"{n_targets} columns: the {n_targets} state(s), then actions or params."
            )
        rest = self.inputs if isinstance(self.inputs, str) else "action"
        return Layout.of_rows(n_features, n_targets, (rest,))

    def _change(self, rows: Floats, targets: Floats) -> Floats:
        return targets - rows[:, self.layout_["state"]] if self.target == "change" else targets

    def _learning_targets(self, rows: Floats, targets: Floats) -> tuple[Floats, Floats | None]:
        return self._change(rows, targets) / self.target_scale_, None

    def _restore(self, rows: Floats, means: Floats, variances: Floats) -> tuple[Floats, Floats]:
        means = means * self.target_scale_
        if self.target == "change":
            means = means + rows[..., self.layout_["state"]]
        return means, variances * self.target_scale_**2

    # -- fitting --------------------------------------------------------------------------

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        if not hasattr(self.relabeler_, "dt_"):
            states = np.concatenate([rows[:, self.layout_["state"]], targets])
            self._learn_ranges(states, tuple(self.layout_.columns["state"]), np.inf)
            self.rolled_range_ = self.state_range_
            self.relabeler_.dt_ = None
        self.dt_ = self.relabeler_.dt_
        largest = np.abs(targets).max(axis=0)
        self.target_scale_ = spread(self._change(rows, targets), largest, weight)
        super()._fit_rows(rows, targets, weight, groups)

    def _fit_states(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        rows, targets = self.relabeler_.fit_resample(ds)
        self.layout_ = self.relabeler_.layout_
        if "past_actions" in self.layout_ and "action" not in self.layout_:
            raise ValueError(
                f'inputs={self.relabeler_.inputs!r}: "past_actions" are known in a roll-out only '
                'where "action" is an input, too. Add it, or leave them out.'
            )
        blind = "action" in self.layout_ and "references" not in self.layout_
        if self.baseline_ is not None and blind:
            raise ValueError(
                f"baseline={self.baseline!r} with actions as inputs: a deviation alone does not "
                'say where the plant is. Give inputs=("action", "references"), or inputs="params".'
            )
        self.rolled_range_ = np.stack([ds.states.min(axis=0), ds.states.max(axis=0)])
        episode = self.relabeler_.sample_indices_
        self._fit_rows(
            rows,
            targets,
            None if weight is None else weight[episode],
            None if groups is None else groups[episode],
        )

    def _fit_episodes(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        self.__dict__.pop("policy_", None)
        super()._fit_episodes(ds, weight, groups)
        if self._clones() and "action" in self.layout_:
            self._fit_policy(ds, weight, groups)

    def _fit_policy(
        self, ds: TrajectoryDataset, weight: Floats | None, groups: NDArray[Any] | None
    ) -> None:
        """Learn the policy from episodes with the states that the controller acted on."""
        if self._history() > 1 and self.baseline_ is not None:
            raise ValueError(
                f"policy='clone' with history={self._history()} and baseline={self.baseline!r}: "
                "the past states of a roll-out are relative to the baseline, those that the "
                "controller saw were not. Leave one of the three out."
            )
        estimator = self.policy_estimator
        self.policy_ = clone_policy(
            ds,
            seeded(ControlLawRegressor() if estimator is None else estimator, self._rng),
            history=self._history(),
            pad=getattr(self.relabeler_, "pad", True),
            timed="dt" in self.layout_,
            weight=weight,
            groups=groups,
        )

    def _default_policy(self) -> dict[str, Any]:
        """Default `policy_estimator`, where one is needed."""
        return {"policy_estimator": ControlLawRegressor()} if self._clones() else {}

    def _clones(self) -> bool:
        return isinstance(self.policy, str)

    def _history(self) -> int:
        """States that a row shows."""
        return int(getattr(self.relabeler_, "history", 1))

    def _fit_door_of_rows(self, X: Any, y: Any, sample_weight: Any, groups: Any) -> None:
        if self._clones():
            raise ValueError(
                "policy='clone' needs episodes: rows do not say which of their columns the "
                "controller saw. Fit on episodes, or give a policy= that is known."
            )
        self.__dict__.pop("policy_", None)
        super()._fit_door_of_rows(X, y, sample_weight, groups)

    # -- roll-outs ------------------------------------------------------------------------

    def _source(self, ds: TrajectoryDataset, actions: str, policy: Any) -> tuple[str, Any]:
        """Where the actions come from: "none", "logged" or "policy", and the policy."""
        policy = self.policy if policy is None else policy
        if "action" not in self.layout_:
            return "none", None
        if isinstance(policy, str):
            if not hasattr(self, "policy_"):
                raise ValueError(
                    f"policy={policy!r}, but the model was fitted without: set policy='clone' and "
                    "fit it again, or give a policy that is known."
                )
            policy = self.policy_
        choice = self.rollout_actions if actions == "auto" else actions
        if choice == "auto":
            choice = "logged" if policy is None else "policy"
        if choice == "policy" and policy is None:
            raise ValueError(
                "actions='policy' needs a policy: give policy= here or in the constructor, or "
                "roll out with actions='logged'."
            )
        if choice == "logged" and ds.actions is None:
            raise MissingFieldError(
                f"{type(self).__name__} needs actions to roll out, but the episodes (or the plan) "
                "have none ahead and there is no policy. Give policy=, or a model with "
                "inputs='params'."
            )
        if choice == "logged":
            self._check_action_width(ds)
        return choice, policy

    def _check_action_width(self, ds: TrajectoryDataset) -> None:
        block = self.layout_["action"]
        if len(ds.action_names) != block.stop - block.start:
            raise ValueError(
                f"the episodes have {len(ds.action_names)} actions, the model was fitted on "
                f"{block.stop - block.start}."
            )

    def _told(self) -> bool:
        # the reference is an input already
        return not isinstance(self.baseline_, ReferenceForecaster)

    def _reads_logged_future(self, ds: TrajectoryDataset, actions: str, policy: Any) -> bool:
        source, policy = self._source(ds, actions, policy)
        told = isinstance(policy, ClonedPolicy) and "references" in policy.blocks
        by_policy = source == "policy" and told
        return source == "logged" or by_policy or "references" in self.layout_

    def _check_time_step(self, ds: TrajectoryDataset) -> None:
        if "dt" in self.layout_ or self.dt_ is None:
            return
        dt = uniform_step(ds)
        if abs(dt - self.dt_) > 1e-3 * self.dt_:
            raise MixedSamplingError(
                f"the model was fitted on steps of {self.dt_:g}, the episodes have steps of "
                f"{dt:g}. "
                'Resample them (ds.resample), or fit with "dt" among inputs=.'
            )

    def _forecast_states(self, query: Query, request: Request) -> Prediction:
        source, policy = self._source(query.ds, request.actions, request.policy)
        self._check_time_step(query.ds)
        std = self._unseen_by(source)
        sight = None if std is None else (std, independent(request.rng))
        inputs = input_rows(self, query, source, policy, sight)
        prediction = self._rolled_out(query, request, inputs)
        if std is not None:
            sight = std, paired(len(query), _SIGHT_SEED)
            inputs = input_rows(self, query, source, policy, sight)
            prediction.mean = self._mean_of_particles(query, inputs)
        prediction.actions = source
        return prediction

    def _unseen_by(self, source: str) -> Floats | None:
        """Standard deviation (d_s,) of what a policy sees beside the states, if there is any."""
        return None

    def _mean_of_particles(self, query: Query, inputs: InputRows) -> Floats:
        """Mean over roll-outs that differ by what their inputs draw (n, H, d_s)."""
        n_particles = self.n_particles + self.n_particles % 2
        initial = np.tile(query.initial_states, (n_particles, 1))
        step = self._step(query, n_particles, None)
        paths = roll_out(initial, query.n_steps, inputs, step, self._limits())
        mean: Floats = paths.reshape(n_particles, len(query), *paths.shape[1:]).mean(axis=0)
        return mean

    def _rolled_out(self, query: Query, request: Request, inputs: InputRows) -> Prediction:
        """Mean by one roll-out of the mean, everything else by particles."""

        def paths_of(copies: int, rng: np.random.Generator | None) -> Floats:
            initial = query.starts(copies, rng)
            step = self._step(query, copies, rng)
            return roll_out(initial, query.n_steps, inputs, step, self._limits())

        prediction = Prediction(paths_of(1, None))
        n_paths = max(request.n_samples or 0, self.n_particles if request.return_std else 0)
        if not n_paths:
            return prediction
        paths = paths_of(n_paths, request.rng).reshape(n_paths, *prediction.mean.shape)
        if request.return_std:
            with np.errstate(invalid="ignore"):
                std = paths.std(axis=0)
            prediction.std = np.where(np.isinf(paths).any(axis=0), np.inf, std)
        if request.n_samples:
            prediction.samples = paths[: request.n_samples].copy()
        return prediction

    def _limits(self) -> Limits:
        low, high = self.rolled_range_
        centre, width = (low + high) / 2, high - low
        clip = None
        if self.clip_states is not None:
            width = np.where(width > 0, width, 1.0)
            clip = (centre - self.clip_states * width / 2, centre + self.clip_states * width / 2)
        width = np.ptp(self.state_range_, axis=0)
        return Limits(clip, centre, DIVERGENCE_RANGES * np.where(width > 0, width, 1.0))

    def _time_grid(self, horizons: Floats) -> tuple[Floats, NDArray[np.intp]]:
        if "dt" in self.layout_:
            return super()._time_grid(horizons)
        dt = 1.0 if self.dt_ is None else self.dt_
        steps = np.round(horizons / dt).astype(np.intp)
        if (np.abs(steps * dt - horizons) > 1e-3 * dt).any():
            raise ValueError(
                f"horizons must be multiples of the time step {dt:g} of a one-step model; "
                "TrajectoryRegressor predicts any."
            )
        return np.arange(1, steps[-1] + 1) * dt, steps - 1
