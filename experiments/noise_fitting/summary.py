"""Evaluate a fitted noise: replay the log before and after, summarise, and draw."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ... import __version__
from ...arrays import Array
from ..figures.style import ALARM, INK, TEAL, dress, new_figure, write_title
from ..run_and_replay.filter_settings import FilterSettings
from ..run_and_replay.log_replay import Progress, replay
from ..run_and_replay.summary import settings_table, summarise
from ..run_and_replay.trace import finite
from .fit import FACTORS, GATE_PROBABILITY, Fitted, NoiseFit

STAGES = ("before", "fitted", "suggested")
COMPARED = ("nis", "nees", "ate", "landmark_rmse", "readings")


def summarise_fit(fit: NoiseFit, *, progress: Progress | None = None) -> dict[str, Any]:
    """Replay the log under each noise, and summarise the fit.

    Returns
    -------
    dict
        ``slamgym``, ``log``, ``estimator``, ``readings``, ``passes``; ``noise``, a list
        of the fitted standard deviations with ``name``, ``unit``, ``before``,
        ``value``, ``low`` and ``high`` of the 95 % interval (None where there is none)
        and ``verdict``; ``runs`` with the noises ``before``, ``fitted`` and
        ``suggested``, of each the ``settings``, ``log_likelihood``, ``rejected``,
        ``whiteness`` of ``bearing`` and ``range``, and as in a replay's summary
        ``nis``, ``nees``, ``ate``, ``landmark_rmse`` and ``readings``; ``inflation`` of
        ``bearing`` and ``range``; ``calibration``, the ``factor`` of the sensor's
        noise that the truth asks for, and ``low`` and ``high`` of its interval, 0 below
        and None above the factors ``tried``; or None;
        ``options``, the line to paste.
    """
    runs: dict[str, Any] = {}
    for done, stage in enumerate(STAGES):
        if progress is not None:
            progress(done, len(STAGES))
        is_known = stage == "suggested" and fit.suggested is fit.fitted
        runs[stage] = runs["fitted"] if is_known else _run(fit, getattr(fit, stage))
    bearing, distance = fit.fitted.whiteness
    return {
        "slamgym": __version__,
        "log": fit.log.name,
        "estimator": fit.before.settings.estimator,
        "readings": fit.readings,
        "passes": fit.passes,
        "noise": [
            row._asdict() | {"low": finite(row.low), "high": finite(row.high)}
            for row in fit.noise
        ],
        "runs": runs,
        "inflation": {"bearing": bearing.inflation, "range": distance.inflation},
        "calibration": None
        if fit.calibration is None
        else {
            **{key: finite(value) for key, value in fit.calibration._asdict().items()},
            "tried": [float(FACTORS[0]), float(FACTORS[-1])],
        },
        "options": options_line(fit.suggested),
    }


def options_line(fitted: Fitted) -> str:
    """Return the options of a command that give a filter this noise."""
    settings = fitted.settings
    given = {
        "--motion-std": ",".join(f"{value:.4g}" for value in settings.motion_std),
        "--measurement-std": ",".join(f"{v:.4g}" for v in settings.measurement_std),
        "--range-std-per-metre": f"{settings.options['range_std_per_metre']:.4g}",
    }
    metres = settings.options.get("bearing_std_metres")
    if metres is not None:
        given["--option"] = f"bearing_std_metres={metres:.4g}"
    gate = settings.options.get("gate_probability")
    if gate is not None:
        given["--gate-probability"] = f"{gate:.9g}"
    return " ".join(f"{option} {value}" for option, value in given.items())


def _run(fit: NoiseFit, fitted: Fitted) -> dict[str, Any]:
    settings = _of_the_readings(fit, fitted.settings)
    run = replay(fit.log, settings.make(fit.log.start), name=settings.estimator)
    summary = summarise(run, settings)
    bearing, distance = fitted.whiteness
    return {
        "settings": settings_table(fitted.settings),
        "log_likelihood": finite(fitted.log_likelihood),
        "rejected": fitted.rejected,
        "whiteness": {
            name: {"p": finite(white.p_value), "first": finite(white.first)}
            for name, white in (("bearing", bearing), ("range", distance))
        },
        **{key: summary[key] for key in COMPARED},
    }


def _of_the_readings(fit: NoiseFit, settings: FilterSettings) -> FilterSettings:
    """Leave out landmark management if the log has its associations."""
    if not fit.is_associated:
        return settings
    plain, gate = settings.unmanaged(), {"gate_probability": GATE_PROBABILITY}
    return replace(plain, options={**gate, **plain.options})


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
    axes = figure.subplots(2, len(stages), sharex=True, sharey=True)
    for column, (name, stage) in enumerate(stages):
        for row, what in enumerate(("bearing", "range")):
            _draw(axes[row, column], f"{what}, {name}", fit.reading_times, stage, row)
        axes[1, column].set_xlabel("time")
    for row in range(2):
        axes[row, 0].set_ylabel("innovation [σ]")
    return figure


def _draw(axes: Axes, title: str, times: Array, stage: Fitted, row: int) -> None:
    innovations, white = stage.innovations[:, row], stage.whiteness[row]
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
