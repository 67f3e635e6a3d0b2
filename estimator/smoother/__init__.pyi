from .batch_smoother import smooth as smooth
from .drive import Drive as Drive
from .recorded_slam import RecordedSlam as RecordedSlam
from .smoothed_drive import SmoothedDrive as SmoothedDrive
from .smoothing_slam import SmoothingSlam as SmoothingSlam
