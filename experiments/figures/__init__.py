"""The figures of a run: map, accuracy, covariance, consistency, noise study.

Every function takes the trace of a run and returns a matplotlib Figure that pyplot does
not manage; `save_figure` writes it.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .accuracy import comparison_figure as comparison_figure
    from .accuracy import covariance_figure as covariance_figure
    from .accuracy import errors_figure as errors_figure
    from .accuracy import truth_figure as truth_figure
    from .maps import map_figure as map_figure
    from .maps import map_sequence as map_sequence
    from .maps import noise_study_figure as noise_study_figure
    from .smoothed import smoothed_figure as smoothed_figure
    from .style import save_figure as save_figure
else:
    __getattr__, __dir__, __all__ = attach(__name__)
