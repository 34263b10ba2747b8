"""Simulated systems that episodes come from, one file a system."""

from trajlearn.envs.base import Environment
from trajlearn.envs.cartpole import Cartpole
from trajlearn.envs.reacher import Reacher

__all__ = ["Cartpole", "Environment", "Reacher"]
