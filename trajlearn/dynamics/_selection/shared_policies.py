"""Policies that several members would learn alike: each is learned once."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from trajlearn.dynamics._learner import seeded
from trajlearn.dynamics._rollouts.cloned_policy import ClonedPolicy, clone_policy
from trajlearn.dynamics.one_step import OneStepRegressor
from trajlearn.regressors._threads import by_workers
from trajlearn.regressors.control_law import ControlLawRegressor
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler

__all__ = ["SharedPolicies"]

Ints = NDArray[np.intp]
# type and parameters of the learner, history, whether it sees the time step
_Settings = tuple[type, str, int, bool]


class SharedPolicies:
    """Cloned policies of members that learn them from the same states, actions and settings.

    Those are one-step models on the states as logged. A member that smooths states first has
    other states, and one alone with its settings learns its policy by itself.

    Parameters
    ----------
    members : list of (str, estimator)
    ds : TrajectoryDataset
    folds : sequence of (train, test)
    rng : Generator
        Of the seeds that a `policy_estimator` leaves open.
    n_jobs : int or None
        Policies learned at once.
    """

    def __init__(
        self,
        members: list[tuple[str, Any]],
        ds: TrajectoryDataset,
        folds: Sequence[tuple[Ints, Ints]],
        rng: np.random.Generator,
        n_jobs: int | None,
    ) -> None:
        self._ds, self._folds, self._n_jobs = ds, folds, n_jobs
        settings = {} if ds.actions is None else {name: _settings(m) for name, m in members}
        kinds = list(settings.values())
        self._kind = {n: s for n, s in settings.items() if s is not None and kinds.count(s) > 1}
        self._learners: dict[_Settings, Any] = {}
        for name, member in members:
            kind = self._kind.get(name)
            if kind is not None and kind not in self._learners:
                self._learners[kind] = seeded(_learner(member), rng)
        self._found: dict[_Settings, dict[int, ClonedPolicy]] = {k: {} for k in self._learners}
        self._seconds = dict.fromkeys(self._learners, 0.0)

    def learn(self, names: Sequence[str], which: Sequence[int]) -> None:
        """Learn the policies of some members on some folds (the number of folds: all episodes)."""
        kinds = dict.fromkeys(self._kind[name] for name in names if name in self._kind)
        wanted = [(kind, k) for kind in kinds for k in which if k not in self._found[kind]]
        jobs = [
            (clone(self._learners[kind]), self._episodes(k), history, timed)
            for kind, k in wanted
            for _, _, history, timed in [kind]
        ]
        found = by_workers(_learned, jobs, self._n_jobs)
        for (kind, k), (policy, seconds) in zip(wanted, found):
            self._found[kind][k] = policy
            self._seconds[kind] += seconds

    def of(self, name: str) -> Mapping[int, ClonedPolicy]:
        """What was learned for a member, by fold; nothing if it shares none."""
        return self._found[self._kind[name]] if name in self._kind else {}

    def seconds(self, name: str) -> float:
        """How long it took to learn the policies of a member."""
        return self._seconds[self._kind[name]] if name in self._kind else 0.0

    def _episodes(self, k: int) -> TrajectoryDataset:
        return self._ds if k == len(self._folds) else self._ds[self._folds[k][0]]


def _settings(member: Any) -> _Settings | None:
    """What, beside the episodes, decides the policy that a member learns; None if others cannot."""
    if not isinstance(member, OneStepRegressor) or member.policy != "clone":
        return None
    smooths = member.denoise is not None or member.latent_velocities
    given = member if member.relabeler is None else member.relabeler
    # a relabeler of one's own may show something else
    known = given is member or type(given) is TransitionRelabeler
    if smooths or member.baseline is not None or not (known and getattr(given, "pad", True)):
        return None
    inputs = [given.inputs] if isinstance(given.inputs, str) else list(given.inputs)
    if "action" not in inputs:
        return None
    learner = _learner(member)
    return type(learner), repr(learner.get_params()), given.history, "dt" in inputs


def _learner(member: OneStepRegressor) -> Any:
    given = member.policy_estimator
    return ControlLawRegressor() if given is None else given


def _learned(
    learner: Any, ds: TrajectoryDataset, history: int, timed: bool
) -> tuple[ClonedPolicy, float]:
    """Policy that a model of a step learns from episodes, and how long it took."""
    began = time.perf_counter()
    groups = np.arange(len(ds)) if ds.group is None else ds.group
    try:
        policy = clone_policy(ds, learner, history=history, timed=timed, groups=groups)
    except Exception as error:
        error.add_note("This happened to a policy that members of a HorizonSelector share.")
        raise
    return policy, time.perf_counter() - began
