from . import agents as agents
from . import envs as envs
from . import estimator as estimator
from . import evaluation as evaluation
from . import experiments as experiments
from . import sim_configs as sim_configs
from .envs import LandmarkWorldEnv as LandmarkWorldEnv
from .estimator import EkfSlam as EkfSlam
from .estimator import InvariantEkfSlam as InvariantEkfSlam
from .estimator import check_estimator as check_estimator
from .estimator import list_estimators as list_estimators
from .estimator import make_estimator as make_estimator
from .evaluation import assert_consistent as assert_consistent
from .experiments.logs import read_log as read_log
from .experiments.monte_carlo import monte_carlo as monte_carlo
from .experiments.runs import replay as replay
from .experiments.trajectories import generate_trajectories as generate_trajectories
from .sim_configs import load_scenario as load_scenario

__version__: str
