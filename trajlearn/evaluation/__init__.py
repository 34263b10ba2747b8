"""How good forecasts are: errors by horizon, cross-validation over horizons, scorers."""

from trajlearn.evaluation.cross_validation import cross_val_forecast, cross_validate_horizons
from trajlearn.evaluation.errors import horizon_errors, reward_errors, summarise
from trajlearn.evaluation.scorers import horizon_scorer

__all__ = [
    "cross_val_forecast",
    "cross_validate_horizons",
    "horizon_errors",
    "horizon_scorer",
    "reward_errors",
    "summarise",
]
