"""Which landmarks a map holds: confirmation, removal and merging.

``policy`` states the rules, and ``managed_slam`` applies them around any filter.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
