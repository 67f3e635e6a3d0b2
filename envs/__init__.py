"""Simulated worlds: robot, sensor, noise, controllers, pictures.

`envs` imports nothing of `estimator`, by design. A simulator that shared the filters'
models could not reveal an error in them. So the drive equation, the measurement and the
wrapping of angles are separate code here.
"""

from typing import TYPE_CHECKING

from ..public_names import attach

if TYPE_CHECKING:
    from . import controllers as controllers
    from . import rendering as rendering
    from . import robot as robot
    from . import vector as vector
    from .bearing_range import BearingRangeSensor as BearingRangeSensor
    from .bearing_range import LineOfSight as LineOfSight
    from .controllers import CONTROLLERS as CONTROLLERS
    from .controllers import Controller as Controller
    from .controllers import OpenLoop as OpenLoop
    from .controllers import RandomWalk as RandomWalk
    from .controllers import VectorController as VectorController
    from .controllers import VectorOpenLoop as VectorOpenLoop
    from .controllers import VectorRandomWalk as VectorRandomWalk
    from .controllers import VectorWaypoints as VectorWaypoints
    from .controllers import Waypoints as Waypoints
    from .controllers import make_controller as make_controller
    from .controllers import make_vector_controller as make_vector_controller
    from .controllers import planned_path as planned_path
    from .landmark_world import LandmarkWorldEnv as LandmarkWorldEnv
    from .noise_streams import SensorSettings as SensorSettings
    from .rendering import *
    from .robot import OdometrySensor as OdometrySensor
    from .robot import UnicycleBodies as UnicycleBodies
    from .robot import UnicycleBody as UnicycleBody
    from .robot import WallContacts as WallContacts
    from .robot import displacement as displacement
    from .vector import *
else:
    __getattr__, __dir__, __all__ = attach(__name__)
