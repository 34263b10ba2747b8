"""Which forecasters a selector tries if it is given none."""

from math import comb
from typing import Any

from trajlearn.dynamics.lstm import LSTMRegressor
from trajlearn.dynamics.one_step import OneStepRegressor
from trajlearn.dynamics.trajectory import TrajectoryRegressor
from trajlearn.exceptions import MixedSamplingError
from trajlearn.regressors import GPRegressor, polynomial
from trajlearn.trajectories import TrajectoryDataset, TransitionRelabeler, as_dataset
from trajlearn.trajectories.times import uniform_step

__all__ = ["clipped_to", "default_members"]

# predicted states stay within this multiple of the range that states seem to have
_CLIP = 1.2
# a polynomial has at most this many terms, and half as many as there are steps
_MOST_TERMS = 1000
# a Gaussian process takes some seconds on so many
_GP_ROWS = 800
# past states where one does not say all
_WINDOW = 5


def default_members(
    ds: TrajectoryDataset,
    *,
    policy: Any = None,
    rollout_actions: str = "auto",
    partial: bool = False,
    lstm: bool = False,
) -> list[tuple[str, Any]]:
    """Formulations that suit what was logged, by name.

    Parameters
    ----------
    ds : TrajectoryDataset or list of Trajectory
    policy : callable, "clone" or None, default=None
        Policy of the roll-outs; None and "clone": learned from the logged actions.
    rollout_actions : {"auto", "logged", "policy"}, default="auto"
        "logged": one-step models replay the logged actions, and need no policy.
    partial : bool, default=False
        Also one-step models for states of which a part is not logged: ``poly1_latent``,
        ``poly2_latent`` and ``poly3_latent`` estimate velocities (equal steps only; they learn the
        policy themselves, since one that was given does not know estimated states),
        ``poly1_window`` and ``network_window`` see the last five states.
    lstm : bool, default=False
        Also a recurrent network, which takes longer than all others; it needs a policy that is
        known, or replays the logged actions.

    Returns
    -------
    list of (str, estimator)
        With actions logged, one-step models: ``poly1``, ``poly2``, ``poly3`` (polynomial least
        squares) and ``network``, each on the states as logged and, where all steps are equal,
        denoised (``poly1_em``, ...); and ``gp``, a Gaussian process on 800 rows. Always ``C``
        (closed loop) and ``T`` (trajectory), which see theta where there are params; without, they
        take the controller for constant.

    Examples
    --------
    >>> import numpy as np
    >>> from trajlearn import TrajectoryDataset
    >>> ds = TrajectoryDataset.from_arrays(np.zeros((3, 5, 1)), params=np.zeros((3, 1)))
    >>> [name for name, _ in default_members(ds)]
    ['C', 'T']
    """
    ds = as_dataset(ds)
    irregular = _irregular(ds)
    clip = clipped_to(len(ds))
    members: list[tuple[str, Any]] = []
    if ds.actions is not None:
        settings: dict[str, Any] = {"clip_states": clip, "rollout_actions": rollout_actions}
        if rollout_actions != "logged":
            settings["policy"] = "clone" if policy is None else policy
        if irregular:
            settings["inputs"] = ("action", "dt")
        learners = _learners(ds, irregular)
        # the smoother wants equal steps
        for ending, denoise in [("", None)] if irregular else [("", None), ("_em", "em")]:
            members += [
                (name + ending, OneStepRegressor(learner, denoise=denoise, **settings))
                for name, learner in learners
            ]
        # exact on smooth plants that are no polynomials; noise is not for it, nor are many rows
        rows = TransitionRelabeler(inputs=settings.get("inputs", "action"), max_rows=_GP_ROWS)
        process = OneStepRegressor(GPRegressor(n_restarts=0), relabeler=rows, **settings)
        members.append(("gp", process))
        if partial:
            members += _for_partial_states(learners, settings, irregular)
        if lstm:
            known = {"policy": policy} if callable(policy) else {}
            recurrent = LSTMRegressor(rollout_actions=rollout_actions, clip_states=clip, **known)
            members.append(("lstm", recurrent))
    closed: Any = ("params", "dt") if irregular else "params"
    members.append(("C", OneStepRegressor(inputs=closed, clip_states=clip)))
    members.append(("T", TrajectoryRegressor()))
    return members


def _for_partial_states(
    learners: list[tuple[str, Any]], settings: dict[str, Any], irregular: bool
) -> list[tuple[str, Any]]:
    """One-step models that estimate velocities, or see more than one state."""
    members = []
    if not irregular:
        own = settings | ({"policy": "clone"} if "policy" in settings else {})
        members = [
            (f"{name}_latent", OneStepRegressor(learner, latent_velocities=True, **own))
            for name, learner in learners[:-1]
        ]
    # higher powers of so many inputs go anywhere in a roll-out
    return members + [
        (f"{name}_window", OneStepRegressor(learner, history=_WINDOW, **settings))
        for name, learner in learners
        if name in ("poly1", "network")
    ]


def _learners(ds: TrajectoryDataset, irregular: bool) -> list[tuple[str, Any]]:
    """Learners of a step; None stands for the network."""
    width = len(ds.state_names) + len(ds.action_names) + irregular
    most = min(_MOST_TERMS, int(ds.lengths.sum()) // 2)
    degrees = [degree for degree in (1, 2, 3) if comb(width + degree, degree) <= most]
    return [*((f"poly{k}", polynomial(degree=k)) for k in degrees), ("network", None)]


def clipped_to(n_episodes: int) -> float:
    """Multiple of the training range within which roll-outs stay."""
    # the range of n uniform numbers falls short of the whole by this factor
    return _CLIP * (n_episodes + 1) / max(n_episodes - 1, 1)


def _irregular(ds: TrajectoryDataset) -> bool:
    try:
        uniform_step(ds)
    except MixedSamplingError:
        return True
    return False
