"""Evaluate a fitted noise: replay the log before and after, and summarise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from ... import __version__
from ..runs.filter_settings import FilterSettings
from ..runs.log_replay import Progress, replay
from ..runs.nan_statistics import finite
from ..runs.summary import settings_table, summarise
from .fit import GATE_PROBABILITY, Fitted, NoiseFit
from .search import FittedNoise

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
        noise that the truth asks for, ``low`` and ``high`` of its interval, or None;
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
        "noise": [_row(noise) for noise in fit.noise],
        "runs": runs,
        "inflation": {"bearing": bearing.inflation, "range": distance.inflation},
        "calibration": _calibration(fit),
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
    options = {k: v for k, v in settings.options.items() if k != "management"}
    gate = {"gate_probability": GATE_PROBABILITY}
    return replace(settings, options=gate | options)


def _calibration(fit: NoiseFit) -> dict[str, float | None] | None:
    if fit.calibration is None:
        return None
    return {key: finite(value) for key, value in fit.calibration._asdict().items()}


def _row(noise: FittedNoise) -> dict[str, Any]:
    row = noise._asdict()
    return row | {
        key: row[key] if math.isfinite(row[key]) else None for key in ("low", "high")
    }
