"""How good an estimate is: numbers in, verdicts out.

``nees`` and ``trajectory_error`` measure, ``hypothesis_tests`` and
``time_average_tests`` decide with known error rates, ``consistency_report`` states it.
"""

from .consistency_report import ConsistencyReport as ConsistencyReport
from .consistency_report import assert_consistent as assert_consistent
from .consistency_report import consistency_report as consistency_report
from .hypothesis_tests import runs_to_detect as runs_to_detect
