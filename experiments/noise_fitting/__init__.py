"""Fit the noise of logs by maximum likelihood, and evaluate the fit."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .fit import NoiseFit as NoiseFit
    from .fit import fit_noise as fit_noise
    from .fit import write_noise as write_noise
    from .search import FittedNoise as FittedNoise
    from .summary import noise_fit_figure as noise_fit_figure
    from .summary import summarise_fit as summarise_fit
else:
    __getattr__, __dir__, __all__ = attach(__name__)
