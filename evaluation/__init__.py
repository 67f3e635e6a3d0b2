"""How good an estimate is: numbers in, verdicts out.

``trajectory_error``, ``nees`` and ``association_scores`` measure, and ``error_bound``
computes the least possible error.  ``hypothesis_tests`` tests with known error rates,
``sequential_tests`` does so at every look at a growing study,
``noise_findings`` tests the noise of a world, and ``diagnosis`` names the cause of an
inconsistency.  ``consistency_report`` collects the tests on one filter.
"""

from typing import TYPE_CHECKING

from ..public_names import attach

if TYPE_CHECKING:
    from .association_scores import AssociationScores as AssociationScores
    from .association_scores import Gospa as Gospa
    from .association_scores import gospa as gospa
    from .association_scores import landmark_identities as landmark_identities
    from .association_scores import oracle_errors as oracle_errors
    from .association_scores import places_of as places_of
    from .association_scores import score_association as score_association
    from .consistency_report import ConsistencyReport as ConsistencyReport
    from .consistency_report import assert_consistent as assert_consistent
    from .consistency_report import evaluate_consistency as evaluate_consistency
    from .diagnosis import CAUSES as CAUSES
    from .diagnosis import Diagnosis as Diagnosis
    from .diagnosis import SmallNoise as SmallNoise
    from .diagnosis import diagnose as diagnose
    from .error_bound import Efficiency as Efficiency
    from .error_bound import PosteriorBound as PosteriorBound
    from .error_bound import efficiency as efficiency
    from .error_bound import posterior_bound as posterior_bound
    from .hypothesis_tests import EQUIVALENCE_MARGIN as EQUIVALENCE_MARGIN
    from .hypothesis_tests import Band as Band
    from .hypothesis_tests import EquivalenceTest as EquivalenceTest
    from .hypothesis_tests import FamilyTest as FamilyTest
    from .hypothesis_tests import HypothesisTest as HypothesisTest
    from .hypothesis_tests import LjungBox as LjungBox
    from .hypothesis_tests import autocorrelation as autocorrelation
    from .hypothesis_tests import average_band as average_band
    from .hypothesis_tests import bootstrap_test as bootstrap_test
    from .hypothesis_tests import equivalence_test as equivalence_test
    from .hypothesis_tests import family_band as family_band
    from .hypothesis_tests import family_test as family_test
    from .hypothesis_tests import final_step_test as final_step_test
    from .hypothesis_tests import ljung_box as ljung_box
    from .hypothesis_tests import nis_test as nis_test
    from .hypothesis_tests import normal_scores as normal_scores
    from .hypothesis_tests import runs_to_detect as runs_to_detect
    from .hypothesis_tests import time_average_test as time_average_test
    from .hypothesis_tests import whiteness_test as whiteness_test
    from .nees import heading_nees as heading_nees
    from .nees import landmark_nees as landmark_nees
    from .nees import normalised_squared_error as normalised_squared_error
    from .nees import pose_nees as pose_nees
    from .nees import position_nees as position_nees
    from .nees import relative_map_nees as relative_map_nees
    from .nees import state_nees as state_nees
    from .noise_findings import noise_sums as noise_sums
    from .sequential_tests import ConfidenceSequence as ConfidenceSequence
    from .sequential_tests import EProcess as EProcess
    from .sequential_tests import average_of as average_of
    from .trajectory_error import Alignment as Alignment
    from .trajectory_error import Exchange as Exchange
    from .trajectory_error import LandmarkDistances as LandmarkDistances
    from .trajectory_error import PositionAccuracy as PositionAccuracy
    from .trajectory_error import align_positions as align_positions
    from .trajectory_error import exchanged_positions as exchanged_positions
    from .trajectory_error import landmark_covariances as landmark_covariances
    from .trajectory_error import landmark_distances as landmark_distances
    from .trajectory_error import poses_at as poses_at
    from .trajectory_error import position_accuracy as position_accuracy
else:
    __getattr__, __dir__, __all__ = attach(__name__)
