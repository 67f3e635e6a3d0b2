from . import controllers as controllers
from . import rendering as rendering
from . import vector as vector
from .landmark_world import LandmarkWorldEnv as LandmarkWorldEnv
from .vector import LandmarkWorldVectorEnv as LandmarkWorldVectorEnv
