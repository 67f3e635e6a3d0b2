from .landmark_world_vector import LandmarkWorldVectorEnv as LandmarkWorldVectorEnv
from .stable_baselines import to_stable_baselines as to_stable_baselines
from .wrappers import FlattenBatch as FlattenBatch
