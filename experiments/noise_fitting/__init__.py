"""Fit the noise of logs by maximum likelihood, and evaluate the fit."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
