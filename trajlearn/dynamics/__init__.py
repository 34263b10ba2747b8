"""Formulations of dynamics: relabel, scale, learn, forecast."""

from trajlearn.dynamics._differentiable import differentiable
from trajlearn.dynamics._selection.default_members import default_members
from trajlearn.dynamics.baselines import (
    CurveForecaster,
    HoldForecaster,
    MeanEpisodeForecaster,
    ReferenceForecaster,
)
from trajlearn.dynamics.calibrated import CalibratedForecaster
from trajlearn.dynamics.direct_reward import DirectRewardGP, DirectRewardNN
from trajlearn.dynamics.distilled import DistilledForecaster
from trajlearn.dynamics.forecast import Forecast
from trajlearn.dynamics.horizon import HorizonFeatures
from trajlearn.dynamics.lstm import LSTMRegressor
from trajlearn.dynamics.one_step import OneStepRegressor
from trajlearn.dynamics.phase import PhaseFeatures
from trajlearn.dynamics.scaling import BlockScaler
from trajlearn.dynamics.selector import HorizonSelector
from trajlearn.dynamics.trajectory import TrajectoryRegressor

__all__ = [
    "BlockScaler",
    "CalibratedForecaster",
    "CurveForecaster",
    "DirectRewardGP",
    "DirectRewardNN",
    "DistilledForecaster",
    "Forecast",
    "HoldForecaster",
    "HorizonFeatures",
    "HorizonSelector",
    "LSTMRegressor",
    "MeanEpisodeForecaster",
    "OneStepRegressor",
    "PhaseFeatures",
    "ReferenceForecaster",
    "TrajectoryRegressor",
    "default_members",
    "differentiable",
]
