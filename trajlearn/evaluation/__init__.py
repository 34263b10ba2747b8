"""How good forecasts are: errors by horizon and state, ranking, cross-validation, scorers."""

from trajlearn.evaluation.by_state import state_errors
from trajlearn.evaluation.cross_validation import cross_val_forecast, cross_validate_horizons
from trajlearn.evaluation.errors import horizon_errors, reward_errors, summarise
from trajlearn.evaluation.ranking import rank_correlation
from trajlearn.evaluation.scorers import horizon_scorer
from trajlearn.evaluation.splits import BlockKFold
from trajlearn.evaluation.starts import starts_every

__all__ = [
    "BlockKFold",
    "cross_val_forecast",
    "cross_validate_horizons",
    "horizon_errors",
    "horizon_scorer",
    "rank_correlation",
    "reward_errors",
    "starts_every",
    "state_errors",
    "summarise",
]
