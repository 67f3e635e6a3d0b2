"""Frames, windows and videos of a world, drawn with matplotlib."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .render_state import RENDER_MODES as RENDER_MODES
    from .render_state import BeliefLike as BeliefLike
    from .render_state import RenderState as RenderState
    from .render_state import covariance_ellipses as covariance_ellipses
    from .renderer import BlittedFigure as BlittedFigure
    from .renderer import WorldRenderer as WorldRenderer
    from .video import check_video as check_video
    from .video import write_video as write_video
else:
    __getattr__, __dir__, __all__ = attach(__name__)
