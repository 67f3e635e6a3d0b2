"""Figure of innovations before and after a fit of the noise."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...arrays import Array
from ..figures.style import ALARM, INK, TEAL, dress, new_figure, write_title
from .fit import Fitted, NoiseFit
from .inflation import Whiteness

BAND = 1.96
SHOWN = 6.0  # standard deviations; what lies beyond is drawn at the edge


def noise_fit_figure(fit: NoiseFit) -> Figure:
    """Draw the innovations, each by its own standard deviation, before and after a fit.

    Rows are bearing and range, columns the noise before, the most likely one, and the
    suggested one where it differs.

    Parameters
    ----------
    fit : NoiseFit
        The fit.
    """
    stages: list[tuple[str, Fitted]] = [("before", fit.before), ("fitted", fit.fitted)]
    if fit.suggested is not fit.fitted:
        stages.append(("suggested", fit.suggested))
    figure = new_figure(4.0 * len(stages), 5.2)
    axes = figure.subplots(2, len(stages), sharex=True, sharey=True, squeeze=False)
    for column, (name, stage) in enumerate(stages):
        for row, what in enumerate(("bearing", "range")):
            _draw(
                axes[row, column],
                f"{what}, {name}",
                fit.reading_times,
                stage.innovations[:, row],
                stage.whiteness[row],
            )
        axes[1, column].set_xlabel("time")
    for row in range(2):
        axes[row, 0].set_ylabel("innovation [σ]")
    return figure


def _draw(
    axes: Axes, title: str, times: Array, innovations: Array, white: Whiteness
) -> None:
    dress(axes)
    axes.axhspan(-BAND, BAND, color=TEAL, alpha=0.18, lw=0)
    known = np.isfinite(innovations)
    t, shown = times[known], np.clip(innovations[known], -SHOWN, SHOWN)
    inside = np.abs(shown) <= BAND
    size = 3.0 if len(shown) <= 600 else 1.2
    for which, colour in ((inside, INK), (~inside, ALARM)):
        axes.plot(t[which], shown[which], ".", color=colour, ms=size)
    axes.set_ylim(-1.05 * SHOWN, 1.05 * SHOWN)
    share = f"{np.mean(inside):.0%} within 95 % band" if len(shown) else "none"
    spread = f"correlation {white.first:.2f}" if np.isfinite(white.first) else ""
    write_title(axes, title, f"{share}, {spread}".rstrip(", "), size=10)
