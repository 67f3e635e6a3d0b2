"""Filters for maps that grow beyond what a dense covariance allows.

``compressed`` gives the results of the full filter: it updates the landmarks around the
robot in each step, and defers the update of the rest.  ``sparse_information`` stores a
sparse information matrix, and limits its links by discarding odometry information.
``submaps`` builds independent local maps in frames of their own, and joins them on
demand.  In each folder, the module ``…_slam`` holds the public filter.
``multifrontal`` factorises the sparse matrices of the latter two, and ``elimination``
chooses the order in which their unknowns are eliminated.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .compressed.compressed_slam import CompressedEkfSlam as CompressedEkfSlam
    from .sparse_information.sparse_information_slam import (
        SparseInformationSlam as SparseInformationSlam,
    )
    from .submaps.submap_slam import SubmapSlam as SubmapSlam
else:
    __getattr__, __dir__, __all__ = attach(__name__)
