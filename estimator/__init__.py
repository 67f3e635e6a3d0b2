"""Landmark-SLAM estimators: numbers in, beliefs out.

A step flows predict → update → belief; the modules are named so.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .batch import BatchSlam as BatchSlam
from .batch import BatchTrace as BatchTrace
from .batch import can_batch as can_batch
from .batch import make_batch as make_batch
from .check_estimator import EstimatorContractError as EstimatorContractError
from .check_estimator import check_estimator as check_estimator
from .ekf_slam import EkfSlam as EkfSlam
from .ideal import IdealEkfSlam as IdealEkfSlam
from .interface import Belief as Belief
from .interface import SlamEstimator as SlamEstimator
from .interface import UpdateReport as UpdateReport
from .invariant import InvariantEkfSlam as InvariantEkfSlam
from .iterated import IteratedEkfSlam as IteratedEkfSlam
from .observability import FirstEstimatesEkfSlam as FirstEstimatesEkfSlam
from .observability import (
    ObservabilityConstrainedEkfSlam as ObservabilityConstrainedEkfSlam,
)
from .registry import list_estimators as list_estimators
from .registry import make_estimator as make_estimator
from .registry import register_estimator as register_estimator
from .robocentric import RobocentricEkfSlam as RobocentricEkfSlam
from .unscented import UnscentedSlam as UnscentedSlam

if TYPE_CHECKING:
    from .consistency_report import ConsistencyReport as ConsistencyReport
    from .consistency_report import assert_consistent as assert_consistent
    from .decisions import runs_to_detect as runs_to_detect
    from .growing_maps.compressed import CompressedEkfSlam as CompressedEkfSlam
    from .growing_maps.sparse_information import (
        SparseInformationSlam as SparseInformationSlam,
    )
    from .growing_maps.submaps import SubmapSlam as SubmapSlam
    from .landmark_management.field_of_view import FieldOfView as FieldOfView
    from .landmark_management.landmark_policy import LandmarkPolicy as LandmarkPolicy
    from .landmark_management.managed import ManagedSlam as ManagedSlam

_LATER = {  # loaded when first asked for: scipy's parts take longer than the rest
    "CompressedEkfSlam": "growing_maps.compressed",
    "ConsistencyReport": "consistency_report",
    "FieldOfView": "landmark_management.field_of_view",
    "LandmarkPolicy": "landmark_management.landmark_policy",
    "ManagedSlam": "landmark_management.managed",
    "SparseInformationSlam": "growing_maps.sparse_information",
    "SubmapSlam": "growing_maps.submaps",
    "assert_consistent": "consistency_report",
    "runs_to_detect": "decisions",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LATER[name]}", __name__), name)
