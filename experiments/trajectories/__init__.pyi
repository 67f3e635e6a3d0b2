from .driven_episodes import drive_episodes as drive_episodes
from .formats import to_slamlog as to_slamlog
from .generate import generate_trajectories as generate_trajectories
from .manifest import TrajectoryDataset as TrajectoryDataset
from .manifest import load_trajectories as load_trajectories
from .trajectory import Trajectory as Trajectory
