from .batch import BatchSlam as BatchSlam
from .batch import can_batch as can_batch
from .batch_results import BatchBeliefs as BatchBeliefs
from .batch_results import BatchTrace as BatchTrace
from .ekf import EkfSlam as EkfSlam
from .first_estimates import FirstEstimatesEkfSlam as FirstEstimatesEkfSlam
from .ideal import IdealEkfSlam as IdealEkfSlam
from .imagine import imagine as imagine
from .invariant import InvariantEkfSlam as InvariantEkfSlam
from .iterated import IteratedEkfSlam as IteratedEkfSlam
from .observability_constrained import (
    ObservabilityConstrainedEkfSlam as ObservabilityConstrainedEkfSlam,
)
from .robocentric import RobocentricEkfSlam as RobocentricEkfSlam
from .unscented import UnscentedSlam as UnscentedSlam
