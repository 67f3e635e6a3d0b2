from ..bearing_range import BearingRangeSensor as BearingRangeSensor
from ..bearing_range import LineOfSight as LineOfSight
from ..noise_streams import SensorNoiseModel as SensorNoiseModel
from ..robot import OdometrySensor as OdometrySensor
