from .landmark_world_vector import LandmarkWorldVectorEnv as LandmarkWorldVectorEnv
from .mixed_worlds import MixedWorlds as MixedWorlds
from .stable_baselines import to_stable_baselines as to_stable_baselines
from .world_batch import WorldBatch as WorldBatch
from .wrappers import FlattenBatch as FlattenBatch
