"""Viewers of whole runs, step by step: a web page, and a recording for rerun.

A `RunFrames` watches a replay; the viewers show what it has kept beside the trace.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
