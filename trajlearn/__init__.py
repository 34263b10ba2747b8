"""Long-term dynamics of controlled systems, from logged episodes, with honest uncertainty."""

import importlib
from typing import Any

from trajlearn._version import __version__

# public name -> module, imported on first use so that `import trajlearn` stays light
_MODULE_OF = {
    "EpisodeRelabeler": "trajectories",
    "KalmanSmoother": "trajectories",
    "ParamsTransformer": "trajectories",
    "StateSpaceModel": "trajectories",
    "SubtrajectoryRelabeler": "trajectories",
    "Trajectory": "trajectories",
    "TrajectoryDataset": "trajectories",
    "TransitionRelabeler": "trajectories",
    "ControlLawRegressor": "regressors",
    "GPRegressor": "regressors",
    "MLPEnsembleRegressor": "regressors",
    "polynomial": "regressors",
    "BlockScaler": "dynamics",
    "CalibratedForecaster": "dynamics",
    "CurveForecaster": "dynamics",
    "DirectRewardGP": "dynamics",
    "DirectRewardNN": "dynamics",
    "DistilledForecaster": "dynamics",
    "Forecast": "dynamics",
    "HoldForecaster": "dynamics",
    "HorizonFeatures": "dynamics",
    "HorizonSelector": "dynamics",
    "LSTMRegressor": "dynamics",
    "MeanEpisodeForecaster": "dynamics",
    "OneStepRegressor": "dynamics",
    "PhaseFeatures": "dynamics",
    "ReferenceForecaster": "dynamics",
    "TrajectoryRegressor": "dynamics",
    "default_members": "dynamics",
    "Airframe": "envs",
    "AttitudePD": "envs",
    "Cartpole": "envs",
    "Quadrotor": "envs",
    "Reacher": "envs",
    "LinearFeedback": "policies",
    "NetworkPolicy": "policies",
    "PID": "policies",
    "load_crazyflie_gains": "datasets",
    "load_nanobench_trefoil": "datasets",
    "BlockKFold": "evaluation",
    "calibration_report": "evaluation",
    "crps_scorer": "evaluation",
    "cross_val_forecast": "evaluation",
    "cross_validate_horizons": "evaluation",
    "horizon_errors": "evaluation",
    "horizon_scorer": "evaluation",
    "rank_correlation": "evaluation",
    "reward_errors": "evaluation",
    "starts_every": "evaluation",
    "state_errors": "evaluation",
    "summarise": "evaluation",
    "trust_horizon": "evaluation",
    "BayesianSearch": "control",
    "MPC": "control",
    "PolicySearch": "control",
    "PredictedReturn": "control",
    "RandomSearch": "control",
    "load": "_persistence",
    "plot_coverage": "plotting",
    "plot_fan": "plotting",
    "plot_forecast": "plotting",
    "plot_horizon_errors": "plotting",
    "plot_pit": "plotting",
    "plot_reliability": "plotting",
    "plot_reward_table": "plotting",
    "plot_search": "plotting",
    "plot_selection": "plotting",
    "plot_slices": "plotting",
    "check_dynamics_estimator": "testing",
    "CalibrationWarning": "exceptions",
    "DivergenceWarning": "exceptions",
    "HorizonWarning": "exceptions",
    "InvalidEpisodeError": "exceptions",
    "MissingFieldError": "exceptions",
    "MixedSamplingError": "exceptions",
    "NoUncertaintyError": "exceptions",
    "SmoothingWarning": "exceptions",
    "UnknownFileError": "exceptions",
    "UnsafeProposalError": "exceptions",
}

__all__ = ["__version__", *_MODULE_OF]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(importlib.import_module(f"trajlearn.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'trajlearn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
