"""Landmark-SLAM estimators: numbers in, beliefs out.

``predict`` → ``update`` → ``belief``.  ``__init__.pyi`` lists the public names; each
loads its module at its first use.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
