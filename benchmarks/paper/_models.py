"""Models by name and settings: the paper's, and the library's defaults."""

from typing import Any

from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures

from trajlearn import (
    GPRegressor,
    LSTMRegressor,
    OneStepRegressor,
    SubtrajectoryRelabeler,
    TrajectoryRegressor,
    paper,
)

# gradient steps of a default network in quick mode, epochs of the paper's
QUICK_STEPS = 600
QUICK_EPOCHS = {"T": 1, "one-step": 2, "LSTM": 1}
# sub-trajectories that a Gaussian process can take
GP_ROWS = 1500

#: How a model is written in tables and legends.
LABELS = {"paper": "", "default": " (ours)"}


def label(model: str, settings: str) -> str:
    """Name of a model in tables and legends."""
    return model + LABELS[settings]


def build(model: str, settings: str, *, policy: Any, mode: str, seed: int) -> Any:
    """Estimator by name; one-step and recurrent models recompute actions by `policy`.

    Settings "paper" know the names of `trajlearn.paper.MODELS`. Settings "default" are ours: T,
    D, PE, C (closed loop), LSTM, "T, GP" (a Gaussian process as the learner) and "D, polynomial"
    (ridge regression on cubic features, the honest baseline on a smooth plant).
    """
    if settings == "paper":
        estimator = paper.model(
            model, **({} if model.startswith("T") else {"policy": policy}), random_state=seed
        )
        if mode == "quick":
            estimator.set_params(**_quick_epochs(model))
        return estimator
    estimator = _default(model, policy, seed)
    if mode == "quick" and model in ("T", "D", "PE", "C"):
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
