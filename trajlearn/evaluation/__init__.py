"""How good forecasts are: errors, uncertainty, trust, ranking, cross-validation, scorers."""

from trajlearn.evaluation.by_state import state_errors
from trajlearn.evaluation.calibration import calibration_report, pit_histogram, reliability
from trajlearn.evaluation.cross_validation import cross_val_forecast, cross_validate_horizons
from trajlearn.evaluation.errors import horizon_errors, reward_errors, summarise
from trajlearn.evaluation.ranking import rank_correlation
from trajlearn.evaluation.scorers import crps_scorer, horizon_scorer
from trajlearn.evaluation.splits import BlockKFold
from trajlearn.evaluation.starts import starts_every
from trajlearn.evaluation.trust import TrustHorizon, trust_horizon
from trajlearn.evaluation.uncertainty import (
    crps,
    energy_scores,
    interval_hits,
    interval_widths,
    negative_log_likelihood,
    pit_values,
)

__all__ = [
    "BlockKFold",
    "TrustHorizon",
    "calibration_report",
    "cross_val_forecast",
    "cross_validate_horizons",
    "crps",
    "crps_scorer",
    "energy_scores",
    "horizon_errors",
    "horizon_scorer",
    "interval_hits",
    "interval_widths",
    "negative_log_likelihood",
    "pit_histogram",
    "pit_values",
    "rank_correlation",
    "reliability",
    "reward_errors",
    "starts_every",
    "state_errors",
    "summarise",
    "trust_horizon",
]
