"""Episodes: the container, files, and relabelling into rows that a regressor can learn."""

from trajlearn.trajectories._kalman_models import StateSpaceModel
from trajlearn.trajectories.coerce import as_dataset, is_episodes
from trajlearn.trajectories.dataset import TrajectoryDataset
from trajlearn.trajectories.episodes import EpisodeRelabeler
from trajlearn.trajectories.frames import from_frame, to_frame
from trajlearn.trajectories.kalman import KalmanSmoother
from trajlearn.trajectories.params import ParamsTransformer
from trajlearn.trajectories.sources import from_gymnasium, from_minari
from trajlearn.trajectories.subtrajectories import SubtrajectoryRelabeler
from trajlearn.trajectories.trajectory import Trajectory
from trajlearn.trajectories.transitions import TransitionRelabeler

__all__ = [
    "EpisodeRelabeler",
    "KalmanSmoother",
    "ParamsTransformer",
    "StateSpaceModel",
    "SubtrajectoryRelabeler",
    "Trajectory",
    "TrajectoryDataset",
    "TransitionRelabeler",
    "as_dataset",
    "from_frame",
    "from_gymnasium",
    "from_minari",
    "is_episodes",
    "to_frame",
]
