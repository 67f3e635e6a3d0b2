"""The figures of a run: map, accuracy, covariance, consistency, noise study.

Every function takes plain arrays and returns a matplotlib Figure, unknown to pyplot;
`save_figure` writes it.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
