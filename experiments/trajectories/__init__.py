"""Generate data sets of trajectories, written in shards, and read them.

``generate`` does the whole job: ``driven_episodes`` → ``trajectory`` → ``formats``
→ ``manifest``, which also reads the data sets.  ``g2o``, ``parquet`` and
``minari_dataset`` are formats of their own.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .driven_episodes import drive_episodes as drive_episodes
    from .formats import to_slamlog as to_slamlog
    from .generate import generate_trajectories as generate_trajectories
    from .manifest import TrajectoryDataset as TrajectoryDataset
    from .manifest import load_trajectories as load_trajectories
    from .trajectory import Trajectory as Trajectory
else:
    __getattr__, __dir__, __all__ = attach(__name__)
