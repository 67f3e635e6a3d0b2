"""The figure of a noise study over many runs."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..figures.style import GREY, INK, dress, new_figure, write_title
from ..monte_carlo.report.estimator_lines import log_ticks, look_of, plain
from ..runs.filter_settings import SIGMAS
from .many_runs import NoiseEffect
from .variations import REFERENCE

_TITLES = {
    "both": ("World and filter change", "the filter assumes the right noise"),
    "world": ("Only the world changes", "the filter assumes the old noise"),
    "filter": ("Only the filter changes", "it assumes a wrong noise"),
}
_SHIFT = 0.28  # of the rows, between × 10 and ÷ 10


def noise_effects_figure(effects: Sequence[NoiseEffect]) -> Figure:
    """Draw the NEES per degree of freedom after every change, a panel for each place.

    Bars are one standard error long to either side.

    Parameters
    ----------
    effects : sequence of NoiseEffect
        Of `noise_effects`.
    """
    places = list(dict.fromkeys(e.changed for e in effects if e.changed in _TITLES))
    labels = list(dict.fromkeys(effect.estimator for effect in effects))
    figure = new_figure(1.2 + 3.4 * len(places), 4.6)
    all_axes = figure.subplots(1, len(places), sharey=True, sharex=True, squeeze=False)
    for axes, place in zip(all_axes[0], places, strict=True):
        _draw(axes, [e for e in effects if e.changed in (place, "nothing")], labels)
        write_title(axes, *_TITLES[place])
        log_ticks(axes, "x")
    names = (str(REFERENCE), *SIGMAS)
    all_axes[0, 0].set_yticks(range(len(names)), names)
    all_axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    figure.supxlabel(
        "mean pose NEES / 3 ± standard error; 1 is expected",
        fontsize=10,
    )
    figure.legend(
        handles=_keys(labels),
        loc="outside upper left",
        ncols=len(labels) + 2,
        frameon=False,
        fontsize=9.5,
    )
    return figure


def _draw(axes: Axes, effects: Sequence[NoiseEffect], labels: list[str]) -> None:
    dress(axes)
    axes.axvline(1.0, color=GREY, lw=1.0, ls=(0, (4, 3)))
    rows = {sigma: row for row, sigma in enumerate((REFERENCE.sigma, *SIGMAS))}
    for effect in effects:
        look = look_of(labels.index(effect.estimator))
        shift = 0.0 if effect.factor == 1 else -_SHIFT if effect.factor > 1 else _SHIFT
        row, error = rows[effect.sigma] + shift, effect.nees_per_degree_error
        if math.isfinite(error):
            ends = effect.nees_per_degree + error * np.array([-1.0, 1.0])
            axes.plot(ends, [row, row], color=look.colour, lw=1.6, zorder=1.9)
        axes.plot(
            effect.nees_per_degree,
            row,
            look.marker,
            color=look.colour,
            ms=6.5,
            mfc=look.colour if effect.factor >= 1 else "white",
            mew=1.4,
        )


def _keys(labels: list[str]) -> list[Line2D]:
    """Return the keys of the legend."""
    keys = [
        Line2D([], [], ls="", marker=look.marker, color=look.colour, label=plain(label))
        for label, look in ((label, look_of(k)) for k, label in enumerate(labels))
    ]
    for text, fill in (("σ × 10", INK), ("σ ÷ 10", "white")):
        keys.append(Line2D([], [], ls="", marker="o", color=INK, mfc=fill, label=text))
    return keys
