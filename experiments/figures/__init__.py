"""The figures of a run: map, accuracy, covariance, consistency, noise study.

Every function takes plain arrays and returns a matplotlib Figure, unknown to pyplot;
`save_figure` writes it.
"""

from .accuracy import truth_figure
from .consistency import errors_figure
from .covariance import covariance_figure
from .maps import map_figure, map_sequence, noise_study_figure
from .style import save_figure

__all__ = [
    "covariance_figure",
    "errors_figure",
    "map_figure",
    "map_sequence",
    "noise_study_figure",
    "save_figure",
    "truth_figure",
]
