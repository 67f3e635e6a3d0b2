from .active_slam import ActiveSlamEnv as ActiveSlamEnv
from .active_slam_baselines import BASELINES as BASELINES
from .active_slam_baselines import make_baseline as make_baseline
from .active_slam_vector import ActiveSlamVectorEnv as ActiveSlamVectorEnv
from .belief_observation import BeliefObservation as BeliefObservation
from .belief_observation_vector import (
    BeliefObservationVector as BeliefObservationVector,
)
from .information_reward import InformationReward as InformationReward
