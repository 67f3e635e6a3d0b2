"""Which landmarks a map holds: confirmation, removal and merging.

``policy`` states the rules, and ``managed_slam`` applies them around any filter.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .managed_slam import ManagedSlam as ManagedSlam
    from .policy import FieldOfView as FieldOfView
    from .policy import LandmarkPolicy as LandmarkPolicy
else:
    __getattr__, __dir__, __all__ = attach(__name__)
