"""The batch smoother: all poses and landmarks of a whole drive at once.

``drive`` records the data, and ``batch_smoother`` finds the most likely poses and
landmarks, and answers for them and their covariances.  ``reassociation`` repairs the
association of the readings.  ``optimiser`` runs
Levenberg-Marquardt; ``elimination`` solves each of its steps.  ``recorded_slam``
records the drive of a filter.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .batch_smoother import SmoothedDrive as SmoothedDrive
    from .batch_smoother import smooth as smooth
    from .drive import Drive as Drive
    from .reassociation import Reassociation as Reassociation
    from .reassociation import reassociate as reassociate
    from .recorded_slam import RecordedSlam as RecordedSlam
    from .recorded_slam import SmoothingSlam as SmoothingSlam
else:
    __getattr__, __dir__, __all__ = attach(__name__)
