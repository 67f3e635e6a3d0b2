"""Landmark-SLAM estimators: numbers in, beliefs out.

A step flows predict → update → belief; the modules are named so.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .check_estimator import EstimatorContractError as EstimatorContractError
from .check_estimator import check_estimator as check_estimator
from .filters.batch import BatchSlam as BatchSlam
from .filters.batch import can_batch as can_batch
from .filters.batch_results import BatchTrace as BatchTrace
from .filters.ekf import EkfSlam as EkfSlam
from .filters.first_estimates import FirstEstimatesEkfSlam as FirstEstimatesEkfSlam
from .filters.ideal import IdealEkfSlam as IdealEkfSlam
from .filters.invariant import InvariantEkfSlam as InvariantEkfSlam
from .filters.iterated import IteratedEkfSlam as IteratedEkfSlam
from .filters.observability_constrained import (
    ObservabilityConstrainedEkfSlam as ObservabilityConstrainedEkfSlam,
)
from .filters.robocentric import RobocentricEkfSlam as RobocentricEkfSlam
from .filters.unscented import UnscentedSlam as UnscentedSlam
from .interface import Belief as Belief
from .interface import SlamEstimator as SlamEstimator
from .interface import UpdateReport as UpdateReport
from .registry import list_estimators as list_estimators
from .registry import make_batch as make_batch
from .registry import make_estimator as make_estimator
from .registry import register_estimator as register_estimator

if TYPE_CHECKING:
    from .large_maps.compressed.compressed_slam import (
        CompressedEkfSlam as CompressedEkfSlam,
    )
    from .large_maps.sparse_information.sparse_information_slam import (
        SparseInformationSlam as SparseInformationSlam,
    )
    from .large_maps.submaps.submap_slam import SubmapSlam as SubmapSlam
    from .map_management.field_of_view import FieldOfView as FieldOfView
    from .map_management.managed_slam import ManagedSlam as ManagedSlam
    from .map_management.policy import LandmarkPolicy as LandmarkPolicy

_LATER = {  # loaded when first asked for: scipy's parts take longer than the rest
    "CompressedEkfSlam": "large_maps.compressed.compressed_slam",
    "FieldOfView": "map_management.field_of_view",
    "LandmarkPolicy": "map_management.policy",
    "ManagedSlam": "map_management.managed_slam",
    "SparseInformationSlam": "large_maps.sparse_information.sparse_information_slam",
    "SubmapSlam": "large_maps.submaps.submap_slam",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LATER[name]}", __name__), name)
