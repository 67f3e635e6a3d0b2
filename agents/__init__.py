"""Where worlds and estimators meet: beliefs to observe, tasks that reward knowledge."""

from typing import TYPE_CHECKING

from ..public_names import attach

if TYPE_CHECKING:
    from . import active_slam_scores as active_slam_scores
    from .active_slam import ActiveSlamEnv as ActiveSlamEnv
    from .active_slam import ActiveSlamVectorEnv as ActiveSlamVectorEnv
    from .active_slam_baselines import BASELINES as BASELINES
    from .active_slam_baselines import make_baseline as make_baseline
    from .belief_observation import BeliefObservation as BeliefObservation
    from .belief_observation import BeliefObservationVector as BeliefObservationVector
    from .information_reward import InformationReward as InformationReward
else:
    __getattr__, __dir__, __all__ = attach(__name__)
