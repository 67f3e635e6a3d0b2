"""Landmark-SLAM estimators: numbers in, beliefs out.

``predict`` → ``update`` → ``belief``.  ``interface`` defines these calls, and
``registry`` makes estimators by name.
"""

from typing import TYPE_CHECKING

from ..public_names import attach

if TYPE_CHECKING:
    from . import association as association
    from . import filters as filters
    from . import large_maps as large_maps
    from . import map_management as map_management
    from . import models as models
    from . import peers as peers
    from . import smoother as smoother
    from .association.constellations import Constellations as Constellations
    from .check_estimator import EstimatorContractError as EstimatorContractError
    from .check_estimator import check_estimator as check_estimator
    from .filters import *
    from .interface import Belief as Belief
    from .interface import ScanDecisions as ScanDecisions
    from .interface import SlamEstimator as SlamEstimator
    from .interface import UpdateReport as UpdateReport
    from .large_maps import *
    from .map_management import *
    from .models import *
    from .peers.catalogue import Peer as Peer
    from .peers.catalogue import list_peers as list_peers
    from .registry import list_estimators as list_estimators
    from .registry import make_batch as make_batch
    from .registry import make_estimator as make_estimator
    from .registry import register_estimator as register_estimator
    from .smoother import *
else:
    __getattr__, __dir__, __all__ = attach(__name__)
