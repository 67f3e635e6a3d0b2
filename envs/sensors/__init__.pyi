from .bearing_range import BearingRangeSensor as BearingRangeSensor
from .line_of_sight import LineOfSight as LineOfSight
from .noise_streams import SensorNoiseModel as SensorNoiseModel
from .odometry import OdometrySensor as OdometrySensor
