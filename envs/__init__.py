"""Worlds that move and measure. `envs` imports nothing of `estimator`, by design.

A simulator that shared the filters' models could not reveal an error in them. So the
drive equation, the measurement and the wrapping of angles are separate code here.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
