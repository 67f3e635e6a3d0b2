"""Figure of a run's errors and innovations against its covariances."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import chdtri

from ...arrays import Array
from ...estimator.models.rigid_motion import additive_error
from ..runs.trace import RunTrace
from .style import ALARM, BLUE, GREY, INK, TEAL, dress, new_figure, write_title

_ROWS = (("x error [m]", "x"), ("y error [m]", "y"), ("θ error [rad]", "θ"))
_LOG_FROM = 8.0  # times the band's upper bound: larger NIS needs a logarithmic axis


def errors_figure(trace: RunTrace) -> Figure:
    """Draw pose errors with their ±3σ bands, and the NIS with its 95% band, over time.

    Without true poses, the figure shows the NIS alone, which needs no truth.

    Parameters
    ----------
    trace : RunTrace
        The run.
    """
    truth = trace.true_poses
    known = truth is not None and bool(np.isfinite(truth).any())
    rows = len(_ROWS) + 1 if known else 1
    figure = new_figure(8.4, 1.0 + 1.9 * rows)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    if truth is not None and known:
        errors = -additive_error(truth, trace.poses)
        std = np.sqrt(
            np.maximum(np.diagonal(trace.pose_covariances, axis1=1, axis2=2), 0)
        )
        for k, (label, name) in enumerate(_ROWS):
            _draw_error(axes[k], trace.t, errors[:, k], std[:, k])
            axes[k].set_ylabel(label)
            inside = np.abs(errors[:, k]) <= 3 * std[:, k]
            share = np.mean(inside[np.isfinite(errors[:, k])])
            title = f"{name}: {share:.0%} of the errors within ±3σ"
            write_title(axes[k], title, size=10)
        _legend_above(axes[0], columns=2)
    _draw_nis(axes[-1], trace)
    axes[-1].set_xlabel(f"time [{trace.time_unit}]")
    figure.align_ylabels(axes)
    return figure


def nis_band(
    dof: NDArray[np.integer], probability: float = 0.95
) -> tuple[Array, Array]:
    """Return the bounds of a consistent filter's NIS for a probability.

    Parameters
    ----------
    dof : ndarray of int, shape (k,)
        Degrees of freedom.
    probability : float, default 0.95
        Probability between the bounds; half of the rest lies below, half above.

    Returns
    -------
    lower, upper : ndarray, shape (k,)
        Quantiles of χ²(dof), nan where dof is 0.
    """
    known = np.where(dof > 0, dof, np.nan)
    tail = (1 - probability) / 2
    return np.asarray(chdtri(known, 1 - tail)), np.asarray(chdtri(known, tail))


def _draw_error(axes: Axes, t: Array, error: Array, std: Array) -> None:
    dress(axes)
    axes.fill_between(t, -3 * std, 3 * std, color=BLUE, alpha=0.15, lw=0, label="±3σ")
    for sign in (-1, 1):
        axes.plot(t, sign * 3 * std, color=BLUE, lw=0.8, alpha=0.6)
    axes.axhline(0, color=GREY, lw=0.6)
    axes.plot(t, error, color=INK, lw=1.2, label="error")
    axes.margins(x=0.01)


def _draw_nis(axes: Axes, trace: RunTrace) -> None:
    """Draw the NIS of the steps with a correction; outliers have another marker."""
    dress(axes)
    lower, upper = nis_band(trace.nis_dof)
    used = trace.nis_dof > 0
    axes.fill_between(
        trace.t,
        lower,
        upper,
        step="mid",
        color=TEAL,
        alpha=0.18,
        lw=0,
        label="95% band",
    )
    inside = used & (trace.nis >= lower) & (trace.nis <= upper)
    size = 4.0 if len(trace.t) <= 300 else 2.0
    for which, marker, colour, label in (
        (inside, "o", INK, "inside"),
        (used & ~inside, "D", ALARM, "outside"),
    ):
        axes.plot(
            trace.t[which], trace.nis[which], marker, color=colour, ms=size, label=label
        )
    axes.set_ylabel("NIS")
    axes.margins(x=0.01)
    if not used.any():
        write_title(axes, "NIS: no step corrected anything", size=10)
        return
    share = np.mean(inside[used])
    write_title(axes, f"NIS: {share:.0%} of the steps in the 95% band", size=10)
    if trace.nis[used].max() > _LOG_FROM * np.nanmax(upper):
        axes.set_yscale("log")
        axes.set_ylim(bottom=max(0.3 * float(np.nanmin(lower)), 1e-3))
    else:
        axes.set_ylim(bottom=0)
    _legend_above(axes, columns=3)


def _legend_above(axes: Axes, columns: int) -> None:
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.01, 0.98),
        ncols=columns,
        frameon=False,
        fontsize=9,
        borderaxespad=0.2,
    )
