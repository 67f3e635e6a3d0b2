from .accuracy import truth_figure as truth_figure
from .consistency import errors_figure as errors_figure
from .covariance import covariance_figure as covariance_figure
from .maps import map_figure as map_figure
from .maps import map_sequence as map_sequence
from .maps import noise_study_figure as noise_study_figure
from .smoothed_map import smoothed_figure as smoothed_figure
from .style import save_figure as save_figure
