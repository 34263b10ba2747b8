"""Roll-outs that carry the differences and the noise of a learner's members along."""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from trajlearn._sklearn import StrOptions
from trajlearn.dynamics._forecaster import Prediction, Request
from trajlearn.dynamics._learner import (
    FullMoments,
    Moments,
    by_member,
    n_members_of,
    own_moments_of,
    required,
)
from trajlearn.dynamics._query import Query
from trajlearn.dynamics._rollouts.rolling import RollingEstimator
from trajlearn.dynamics._rollouts.rollout import InputRows, Step
from trajlearn.dynamics.propagation import BY_GAUSSIANS, PROPAGATIONS
from trajlearn.dynamics.propagation._gaussians import TransitionStep, roll_gaussians
from trajlearn.dynamics.propagation._gp import gp_moments
from trajlearn.dynamics.propagation._particles import drawn_step, expected_step, member_step
from trajlearn.dynamics.propagation._steps import Image, linearised, mean_only, unscented

__all__ = ["PropagatingEstimator"]

Floats = NDArray[np.float64]


class PropagatingEstimator(RollingEstimator):
    """Rolling estimator with a choice of `propagation`."""

    propagation: str
    action_range_: Floats

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **RollingEstimator._parameter_constraints,
        "propagation": [StrOptions(set(PROPAGATIONS))],
    }

    @abstractmethod
    def _has_exact_moments(self) -> bool:
        """Whether the moments of a Gaussian after the step are known exactly."""

    def _fit_rows(self, rows: Floats, targets: Floats, weight: Floats | None, groups: Any) -> None:
        if "previous" in self.layout_:
            actions = rows[:, self.layout_["action"]]
            self.action_range_ = np.stack([actions.min(axis=0), actions.max(axis=0)])
        super()._fit_rows(rows, targets, weight, groups)

    def _step(self, query: Query, copies: int, rng: np.random.Generator | None) -> Step:
        if rng is None:
            return expected_step(self._moments(means_only=True))
        if self.propagation == "expectation":
            return drawn_step(self._full(self._moments()), rng)
        n_members = n_members_of(self.estimator_)
        moments = by_member(self._full(self._own_moments()), n_members)
        if self.propagation == "ts1":
            return member_step(moments, n_members, rng)
        member = np.repeat(rng.permutation(np.arange(copies) % n_members), len(query))
        return member_step(moments, member, rng)

    def _own_moments(self) -> Moments:
        """Function from raw rows of each member's own (E, n, k) to means and variances."""
        learner = own_moments_of(self.estimator_)

        def moments(rows: Floats) -> tuple[Floats, Floats | None]:
            scaled = self._scaled(rows.reshape(-1, rows.shape[-1]))
            means, variances = learner(scaled.reshape(*rows.shape[:2], -1))
            known = np.zeros_like(means) if variances is None else variances
            means, known = self._restore(rows, means, known)
            return means, None if variances is None else known

        return moments

    def _full(self, moments: Moments, *, needed: bool = True) -> FullMoments:
        """The same with variances, which are zero where there are none and none is `needed`."""

        def full(rows: Floats) -> tuple[Floats, Floats]:
            means, variances = moments(rows)
            if variances is None and not needed:
                return means, np.zeros_like(means)
            return means, required(variances, self.estimator_)

        return full

    def _rolled_out(self, query: Query, request: Request, inputs: InputRows) -> Prediction:
        if self.propagation not in PROPAGATIONS:
            # fit has checked it, but it may have been set since
            raise ValueError(
                f"propagation = {self.propagation!r}; choose one of {sorted(PROPAGATIONS)}."
            )
        if self.propagation not in BY_GAUSSIANS:
            return super()._rolled_out(query, request, inputs)
        if self._history() > 1:
            raise ValueError(
                f"propagation={self.propagation!r} carries a Gaussian of one state, and "
                f'history={self._history()} shows the model several: use propagation="tsinf", '
                '"ts1" or "expectation".'
            )
        initial, n_samples = query.initial_states, request.n_samples or 0
        uncertain = request.return_std or bool(n_samples)
        if "previous" in self.layout_:
            # what stands for an action before the start is not read
            before = np.zeros((len(query), len(self.layout_.columns["previous"])))
            initial = np.concatenate([initial, before], axis=1)
        root = query.start_root
        if root is not None:
            wider = initial.shape[1] - root.shape[-1]
            root = np.pad(root, ((0, 0), (0, wider), (0, wider)))
        rolled = roll_gaussians(
            initial,
            query.n_steps,
            n_members_of(self.estimator_),
            self._transition(inputs, uncertain=uncertain),
            self._limits(),
            initial_root=root,
            n_samples=n_samples,
            rng=request.rng,
        )
        std = rolled.std if request.return_std else None
        return Prediction(rolled.mean, std, rolled.samples)

    def _transition(self, inputs: InputRows, *, uncertain: bool) -> TransitionStep:
        """Step of the members' Gaussians."""
        moments = self._full(self._own_moments(), needed=uncertain)
        image = Image(inputs, moments, self._limits(), carries="previous" in self.layout_)
        width = self._widths()
        if self.propagation == "unscented":
            return unscented(image, len(width))
        if self._has_exact_moments():
            return gp_moments(
                self.estimator_,
                image,
                self._scaled,
                width,
                target_scale=self.target_scale_,
                change=self.target == "change",
            )
        return linearised(image, width) if uncertain else mean_only(image)

    def _widths(self) -> Floats:
        """Training range of each number of a point: state, and action before if it is an input."""
        width = np.ptp(self.rolled_range_, axis=0)
        if "previous" in self.layout_:
            width = np.concatenate([width, np.ptp(self.action_range_, axis=0)])
        return np.where(width > 0, width, 1.0)
