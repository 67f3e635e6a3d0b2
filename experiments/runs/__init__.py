"""Run filters over a log or over simulated worlds, and summarise the runs."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
