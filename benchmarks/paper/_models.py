"""Models by name and settings: the paper's, and the library's defaults."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures

from trajlearn import (
    PID,
    BlockScaler,
    GPRegressor,
    HorizonFeatures,
    LinearFeedback,
    LSTMRegressor,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryRegressor,
    paper,
)

# gradient steps of a default network in quick mode, epochs of the paper's
QUICK_STEPS = 600
QUICK_EPOCHS = {"T": 1, "one-step": 2, "LSTM": 1}
# decoupled weight decay of a network that sees what the controller computes
FEATURES_WEIGHT_DECAY = 0.1
# sub-trajectories that a Gaussian process can take
GP_ROWS = 1000

#: How a model is written in tables and legends.
LABELS = {"paper": "", "default": " (ours)"}


def label(model: str, settings: str) -> str:
    """Name of a model in tables and legends."""
    return model + LABELS[settings]


def build(model: str, settings: str, *, policy: Any, mode: str, seed: int) -> Any:
    """Estimator by name; one-step and recurrent models recompute actions by `policy`.

    Settings "paper" know the names of `trajlearn.paper.MODELS`. Settings "default" are ours: T,
    D, PE, C (closed loop), LSTM, "T, features" (T sees what the controller computes from the first
    state and theta), "T, GP" (a Gaussian process as the learner) and "D, polynomial" (ridge
    regression on cubic features, the honest baseline on a smooth plant).
    """
    if settings == "paper":
        estimator = paper.model(
            model, **({} if model.startswith("T") else {"policy": policy}), random_state=seed
        )
        if mode == "quick":
            estimator.set_params(**_quick_epochs(model))
        return estimator
    estimator = _default(model, policy, seed)
    if mode == "quick" and model in ("T", "T, features", "D", "PE", "C"):
        estimator.set_params(estimator__max_steps=QUICK_STEPS)
    if mode == "quick" and model == "LSTM":
        estimator.set_params(max_epochs=2)
    return estimator


def _quick_epochs(model: str) -> dict[str, int]:
    if model == "LSTM":
        return {"max_epochs": QUICK_EPOCHS["LSTM"]}
    return {"estimator__max_epochs": QUICK_EPOCHS["T" if model.startswith("T") else "one-step"]}


def _default(model: str, policy: Any, seed: int) -> Any:
    if model == "T":
        return TrajectoryRegressor(random_state=seed)
    if model == "T, features":
        scaler = BlockScaler(horizon=HorizonFeatures(), features=controller_features(policy))
        estimator = TrajectoryRegressor(scaler=scaler, random_state=seed)
        decay = FEATURES_WEIGHT_DECAY if isinstance(policy, PID) else 0.0
        return estimator.set_params(estimator__weight_decay=decay)
    if model == "T, GP":
        rows = SubtrajectoryRelabeler(starts="early", horizons="mixture", max_rows=GP_ROWS)
        return TrajectoryRegressor(GPRegressor(), relabeler=rows, random_state=seed)
    if model == "D":
        return OneStepRegressor(policy=policy, random_state=seed)
    if model == "PE":
        ensemble = OneStepRegressor(policy=policy, random_state=seed)
        return ensemble.set_params(estimator__n_members=5, estimator__probabilistic=True)
    if model == "D, polynomial":
        learner = make_pipeline(PolynomialFeatures(3), Ridge(1e-6))
        return OneStepRegressor(learner, policy=policy, random_state=seed)
    if model == "C":
        return OneStepRegressor(inputs="params", random_state=seed)
    if model == "LSTM":
        return LSTMRegressor(policy=policy, random_state=seed)
    raise ValueError(f"there are no default settings for {model!r}.")


# -- what a controller computes ---------------------------------------------------------------


def controller_features(policy: Any) -> Any:
    """Features of a policy of the paper for `BlockScaler`; they can go to other processes."""
    if isinstance(policy, PID):
        return PIDFeatures(policy)
    if isinstance(policy, LinearFeedback):
        return FeedbackFeatures(policy)
    raise ValueError(f"there are no features of a {type(policy).__name__}: write them here.")


@dataclass(frozen=True)
class PIDFeatures:
    """Of every joint: control error, proportional part of the action, equilibrium.

    The equilibrium is given in the sine of the angle, which for a target in cosines leaves the
    sign open. The derivative part is left out: velocities are in the state already.
    """

    policy: PID

    def __call__(
        self, states: NDArray[np.float64], params: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        cos, sin, _ = np.hsplit(states, 3)
        gain, _, target = np.hsplit(params, 3)
        if self.policy.feedback == "angle":
            error, equilibrium = target - np.arctan2(sin, cos), np.sin(target)
        else:
            error, equilibrium = target - cos, np.sqrt(np.maximum(1 - target**2, 0.0))
        proportional = _clipped(self.policy.p_scale * gain * error, self.policy)
        return np.concatenate([error, proportional, equilibrium], axis=1)


@dataclass(frozen=True)
class FeedbackFeatures:
    """The action, as it is applied and before it is clipped."""

    policy: LinearFeedback

    def __call__(
        self, states: NDArray[np.float64], params: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        wanted = replace(self.policy, bounds=None)(states, params, np.zeros(len(states)))
        return np.concatenate([_clipped(wanted, self.policy), wanted], axis=1)


def _clipped(actions: NDArray[np.float64], policy: PID | LinearFeedback) -> NDArray[np.float64]:
    return actions if policy.bounds is None else np.clip(actions, *policy.bounds)
