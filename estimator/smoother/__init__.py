"""The batch smoother: all poses and landmarks of a whole drive at once.

``drive`` records the data, ``batch_smoother`` finds the most likely poses and landmarks
by Levenberg-Marquardt, and ``smoothed_drive`` answers for them and their covariances.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
