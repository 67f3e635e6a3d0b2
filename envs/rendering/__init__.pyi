from .ellipses import covariance_ellipses as covariance_ellipses
from .renderer import WorldRenderer as WorldRenderer
from .video import write_video as write_video
