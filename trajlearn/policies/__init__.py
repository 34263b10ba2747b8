"""Controllers as vectorised functions of state, control parameters and time.

A policy is any callable ``policy(states, params, times) -> actions`` that answers for many
episodes at once. It carries no memory: what it needs to know is in its three arguments, so
a learned model can ask it for the action at a state that no simulator ever visited.
"""

from trajlearn.policies.base import Policy
from trajlearn.policies.linear import LinearFeedback
from trajlearn.policies.network import NetworkPolicy
from trajlearn.policies.pid import PID

__all__ = ["PID", "LinearFeedback", "NetworkPolicy", "Policy"]
