"""Motion and measurement models: values, Jacobians and their compiled twins."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .bearing_range import LandmarkLocation as LandmarkLocation
    from .bearing_range import MeasurementPrediction as MeasurementPrediction
    from .bearing_range import locate_landmark as locate_landmark
    from .bearing_range import predict_measurement as predict_measurement
    from .bearing_range import wrap_angle as wrap_angle
    from .model_checks import check_motion as check_motion
    from .model_checks import check_sensor as check_sensor
    from .motions import Motion as Motion
    from .motions import MotionPrediction as MotionPrediction
    from .motions import bicycle as bicycle
    from .motions import differential as differential
    from .motions import find_motion as find_motion
    from .motions import predict_pose as predict_pose
    from .sensors import Sensor as Sensor
    from .sensors import find_sensor as find_sensor
else:
    __getattr__, __dir__, __all__ = attach(__name__)
