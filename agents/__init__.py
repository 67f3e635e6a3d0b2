"""Where worlds and estimators meet: beliefs to observe, tasks that reward knowledge."""

from .active_slam import ActiveSlamEnv as ActiveSlamEnv
from .active_slam_vector import ActiveSlamVectorEnv as ActiveSlamVectorEnv
from .belief_observation import BeliefObservation as BeliefObservation
from .belief_observation_vector import (
    BeliefObservationVector as BeliefObservationVector,
)
from .information_reward import InformationReward as InformationReward
