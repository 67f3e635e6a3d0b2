"""Many worlds at once: native vector environments, batches and their wrappers."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .landmark_world_vector import LandmarkWorldVectorEnv as LandmarkWorldVectorEnv
    from .world_batch import WorldBatch as WorldBatch
    from .wrappers import FlattenBatch as FlattenBatch
    from .wrappers import to_stable_baselines as to_stable_baselines
else:
    __getattr__, __dir__, __all__ = attach(__name__)
