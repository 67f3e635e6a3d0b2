"""Where worlds and estimators meet: beliefs to observe, tasks that reward knowledge."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
