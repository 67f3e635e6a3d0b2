from .batch_smoother import SmoothedDrive as SmoothedDrive
from .batch_smoother import smooth as smooth
from .drive import Drive as Drive
from .recorded_slam import RecordedSlam as RecordedSlam
from .recorded_slam import SmoothingSlam as SmoothingSlam
