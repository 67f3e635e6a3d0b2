"""Readers of public log formats, one module each.

``any_format`` recognises a format by the first line of the file.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
