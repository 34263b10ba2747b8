"""Policy search and planning on top of any dynamics estimator."""

from trajlearn.control.bayesian import BayesianSearch
from trajlearn.control.mpc import MPC, Plan
from trajlearn.control.objective import Assessment, PredictedReturn
from trajlearn.control.policy_search import PolicySearch
from trajlearn.control.random_search import RandomSearch

__all__ = [
    "MPC",
    "Assessment",
    "BayesianSearch",
    "Plan",
    "PolicySearch",
    "PredictedReturn",
    "RandomSearch",
]
