from .compressed.compressed_slam import CompressedEkfSlam as CompressedEkfSlam
from .sparse_information.sparse_information_slam import (
    SparseInformationSlam as SparseInformationSlam,
)
from .submaps.submap_slam import SubmapSlam as SubmapSlam
