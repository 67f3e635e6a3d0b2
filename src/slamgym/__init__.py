"""Landmark-SLAM worlds for Gymnasium, and EKF-SLAM estimators to run in them.

``import slamgym`` registers the environments.  Every other name is loaded at its first
use.  The parts are :mod:`slamgym.sim_configs`,
:mod:`slamgym.envs`, :mod:`slamgym.estimator`, :mod:`slamgym.evaluation`,
:mod:`slamgym.agents` and :mod:`slamgym.experiments`.
"""

from typing import TYPE_CHECKING

import gymnasium
from gymnasium.envs.registration import EnvSpec

from .public_names import attach, is_here

__version__ = "0.1.0"

if TYPE_CHECKING:
    from . import agents as agents
    from . import argument_checks as argument_checks
    from . import envs as envs
    from . import estimator as estimator
    from . import evaluation as evaluation
    from . import experiments as experiments
    from . import sim_configs as sim_configs
    from .envs import LandmarkWorldEnv as LandmarkWorldEnv
    from .envs.controllers import Waypoints as Waypoints
    from .estimator import Belief as Belief
    from .estimator import EkfSlam as EkfSlam
    from .estimator import InvariantEkfSlam as InvariantEkfSlam
    from .estimator import LandmarkPolicy as LandmarkPolicy
    from .estimator import UpdateReport as UpdateReport
    from .estimator import check_estimator as check_estimator
    from .estimator import list_estimators as list_estimators
    from .estimator import make_estimator as make_estimator
    from .estimator import register_estimator as register_estimator
    from .evaluation import assert_consistent as assert_consistent
    from .experiments.judging import judge as judge
    from .experiments.logs import read_log as read_log
    from .experiments.monte_carlo_study import consistency_of as consistency_of
    from .experiments.monte_carlo_study import monte_carlo as monte_carlo
    from .experiments.noise_fitting import fit_noise as fit_noise
    from .experiments.run_and_replay import replay as replay
    from .experiments.run_and_replay.log_smoothing import smooth as smooth
    from .experiments.trajectories import generate_trajectories as generate_trajectories
    from .experiments.trajectories import load_trajectories as load_trajectories
    from .sim_configs import Scenario as Scenario
    from .sim_configs import load_scenario as load_scenario
else:
    __getattr__, __dir__, __all__ = attach(__name__)


class WorldSpec(EnvSpec):
    """A specification whose keywords are written as JSON, whatever their types.

    Gymnasium hands out copies of the registered one.
    """

    def to_json(self) -> str:
        """Write the specification as JSON."""
        from .envs.specs import plain_spec  # noqa: PLC0415 (a filter does not need it)

        return plain_spec(self).to_json()


_TASKS = {
    "LandmarkWorld": ("envs.landmark_world", "envs.vector.landmark_world_vector"),
    "ActiveSlam": ("agents.active_slam", "agents.active_slam"),
}
for _task, (_single, _many) in _TASKS.items():
    if is_here(_single):
        _spec = WorldSpec(
            id=f"slamgym/{_task}-v0",
            entry_point=f"slamgym.{_single}:{_task}Env",
            vector_entry_point=f"slamgym.{_many}:{_task}VectorEnv",
        )
        gymnasium.registry[_spec.id] = _spec
