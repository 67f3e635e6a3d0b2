"""The figures of a run: map, accuracy, covariance, consistency, noise study.

Every function takes the trace of a run and returns a matplotlib Figure that pyplot does
not manage; `save_figure` writes it.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
