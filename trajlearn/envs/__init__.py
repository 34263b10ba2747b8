"""Simulated systems that episodes come from, one file a system."""

from trajlearn.envs._attitude_pd import AttitudePD
from trajlearn.envs._rigid_body import Airframe
from trajlearn.envs.base import Environment
from trajlearn.envs.cartpole import Cartpole
from trajlearn.envs.quadrotor import Quadrotor
from trajlearn.envs.reacher import Reacher

__all__ = ["Airframe", "AttitudePD", "Cartpole", "Environment", "Quadrotor", "Reacher"]
