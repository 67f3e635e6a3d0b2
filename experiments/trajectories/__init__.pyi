from .dataset import TrajectoryDataset as TrajectoryDataset
from .dataset import load_trajectories as load_trajectories
from .driven_episodes import drive_episodes as drive_episodes
from .formats.slamlog_files import to_slamlog as to_slamlog
from .generate import generate_trajectories as generate_trajectories
from .trajectory import Trajectory as Trajectory
