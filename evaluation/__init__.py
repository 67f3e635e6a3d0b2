"""How good an estimate is: numbers in, verdicts out.

``trajectory_error`` and ``nees`` measure.  ``hypothesis_tests`` and
``time_average_tests`` decide with known error rates.  ``consistency_report`` collects
the decisions on one filter.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
