"""Our own contract, for anybody's dynamics estimators."""

from trajlearn.testing._contract import check_dynamics_estimator

__all__ = ["check_dynamics_estimator"]
