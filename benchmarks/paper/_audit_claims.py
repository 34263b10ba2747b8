"""What the paper claims, in its order, and the stored results that speak for or against it.

Statements are the paper's, in our words; every number comes from a table.
"""

from benchmarks.paper._audit_data import data_types, reward_prediction, sample_efficiency
from benchmarks.paper._audit_errors import (
    beyond_training,
    ensembles,
    error_growth,
    long_horizons,
    recomputed_actions,
    short_horizons,
    trajectory_ensembles,
)
from benchmarks.paper._audit_hardware import hardware
from benchmarks.paper._audit_time import continuous_time, duels_in_time, planning
from benchmarks.paper._claims import Claim, Sources


def claims(sources: Sources) -> list[Claim]:
    """Every claim that the page judges."""
    return [
        long_horizons(sources),
        short_horizons(sources),
        beyond_training(sources),
        error_growth(sources),
        hardware(sources),
        recomputed_actions(sources),
        ensembles(sources),
        trajectory_ensembles(sources),
        sample_efficiency(sources),
        reward_prediction(sources),
        data_types(sources),
        planning(sources),
        continuous_time(sources),
        duels_in_time(sources),
    ]
