"""Landmark-SLAM estimators: numbers in, beliefs out.

A step flows predict → update → belief; the modules are named so.
"""

from .check_estimator import EstimatorContractError as EstimatorContractError
from .check_estimator import check_estimator as check_estimator
from .ekf_slam import EkfSlam as EkfSlam
from .interface import Belief as Belief
from .interface import SlamEstimator as SlamEstimator
from .interface import UpdateReport as UpdateReport
from .registry import list_estimators as list_estimators
from .registry import make_estimator as make_estimator
from .registry import register_estimator as register_estimator
