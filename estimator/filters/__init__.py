"""The EKF-SLAM filters, and batches of them."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .batch import BatchBeliefs as BatchBeliefs
    from .batch import BatchSlam as BatchSlam
    from .batch import BatchTrace as BatchTrace
    from .batch import can_batch as can_batch
    from .ekf import EkfSlam as EkfSlam
    from .ekf import FirstEstimatesEkfSlam as FirstEstimatesEkfSlam
    from .ekf import InvariantEkfSlam as InvariantEkfSlam
    from .ekf import IteratedEkfSlam as IteratedEkfSlam
    from .ekf import ObservabilityConstrainedEkfSlam as ObservabilityConstrainedEkfSlam
    from .ideal import IdealEkfSlam as IdealEkfSlam
    from .imagine import imagine as imagine
    from .robocentric import RobocentricEkfSlam as RobocentricEkfSlam
    from .unscented import UnscentedSlam as UnscentedSlam
else:
    __getattr__, __dir__, __all__ = attach(__name__)
