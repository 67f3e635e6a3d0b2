"""How good an estimate is: numbers in, verdicts out.

``trajectory_error``, ``nees``, ``association_scores`` and ``gospa`` measure.
``hypothesis_tests``, ``whiteness`` and ``time_average_tests`` test with known error
rates.  ``consistency_report`` collects the tests on one filter.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
