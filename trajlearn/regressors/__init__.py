"""Plain regressors of rows: they know nothing about time."""

from trajlearn.regressors.gp import GPRegressor
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["GPRegressor", "MLPEnsembleRegressor"]
