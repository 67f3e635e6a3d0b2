"""The figures of a run: map, accuracy, covariance, consistency, noise study.

Every function takes plain arrays and returns a matplotlib Figure, unknown to pyplot;
`save_figure` writes it.
"""

from .accuracy_plots import truth_figure
from .consistency_plots import errors_figure
from .covariance_plots import covariance_figure
from .figure_style import save_figure
from .map_plots import NoisePanel, map_figure, map_sequence, noise_study_figure

__all__ = [
    "NoisePanel",
    "covariance_figure",
    "errors_figure",
    "map_figure",
    "map_sequence",
    "noise_study_figure",
    "save_figure",
    "truth_figure",
]
