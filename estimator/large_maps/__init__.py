"""Filters for maps that grow beyond what a dense covariance allows.

``compressed`` defers the exact update of distant landmarks, ``sparse_information``
keeps a sparse information matrix, and ``submaps`` builds local maps in frames of their
own and joins them on demand.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
