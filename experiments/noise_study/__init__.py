"""Noise studies: scale each noise up and down, one at a time."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
