"""Plain regressors of rows: they know nothing about time."""

from trajlearn.regressors._polynomial import polynomial
from trajlearn.regressors.control_law import ControlLawRegressor
from trajlearn.regressors.gp import GPRegressor
from trajlearn.regressors.mlp import MLPEnsembleRegressor

__all__ = ["ControlLawRegressor", "GPRegressor", "MLPEnsembleRegressor", "polynomial"]
