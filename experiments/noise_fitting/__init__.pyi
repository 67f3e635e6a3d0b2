from .fit import NoiseFit as NoiseFit
from .fit import fit_noise as fit_noise
from .fit import write_noise as write_noise
from .search import FittedNoise as FittedNoise
from .summary import noise_fit_figure as noise_fit_figure
from .summary import summarise_fit as summarise_fit
