"""Filters for maps that grow beyond what a dense covariance allows.

``compressed`` gives the results of the full filter: it updates the landmarks around the
robot in each step, and defers the update of the rest.  ``sparse_information`` stores a
sparse information matrix, and limits its links by discarding odometry information.
``submaps`` builds independent local maps in frames of their own, and joins them on
demand.  ``sparse_cholesky`` factorises the sparse matrices of the latter two.  In each
folder, the module ``…_slam`` holds the public filter.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
