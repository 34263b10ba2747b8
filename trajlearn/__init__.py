"""Long-term dynamics of controlled systems, from logged episodes, with honest uncertainty."""

import importlib
from typing import Any

from trajlearn._version import __version__

# public name -> module, imported on first use so that `import trajlearn` stays light
_MODULE_OF = {
    "Trajectory": "trajectories",
    "TrajectoryDataset": "trajectories",
    "SubtrajectoryRelabeler": "trajectories",
    "TransitionRelabeler": "trajectories",
    "EpisodeRelabeler": "trajectories",
    "TrajectoryRegressor": "dynamics",
    "Forecast": "dynamics",
    "BlockScaler": "dynamics",
    "HorizonFeatures": "dynamics",
    "MLPEnsembleRegressor": "regressors",
    "Cartpole": "envs",
    "LinearFeedback": "policies",
    "OneStepRegressor": "dynamics",
    "DirectRewardGP": "dynamics",
    "DirectRewardNN": "dynamics",
    "GPRegressor": "regressors",
    "load": "_persistence",
}

__all__ = ["__version__", *_MODULE_OF]


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(importlib.import_module(f"trajlearn.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'trajlearn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
