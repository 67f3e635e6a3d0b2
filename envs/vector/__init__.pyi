from .landmark_world_vector import LandmarkWorldVectorEnv as LandmarkWorldVectorEnv
from .world_batch import MixedWorlds as MixedWorlds
from .world_batch import WorldBatch as WorldBatch
from .wrappers import FlattenBatch as FlattenBatch
from .wrappers import to_stable_baselines as to_stable_baselines
