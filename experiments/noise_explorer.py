"""A page with sliders for the noise: it shows the NEES, the ellipses and the verdict.

`explore_noise` runs filters over a grid of factors on the noise of motion and of
measurements; `write_explorer` writes what it found as one page without network.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from ..arrays import Array
from ..envs.controllers import make_controller
from ..estimator.models.sensors import find_sensor
from ..evaluation.hypothesis_tests import average_band
from ..sim_configs import Scenario
from ..sim_configs.scenario_files import replace_when_written
from .figures.style import page_environment
from .logs.recording import record_episode
from .logs.slamlog import SlamLog
from .monte_carlo_study import monte_carlo, summarise_monte_carlo
from .monte_carlo_study.runner import with_noise_times
from .monte_carlo_study.verdict import POSE_FREEDOM, EstimatorScores, scores_of
from .run_and_replay.filter_settings import EstimatorChoice, estimator_choices
from .run_and_replay.log_replay import Progress, replay
from .run_and_replay.trace import RunTrace
from .viewers.run_page import PARTS, hash_of, inline_json

#: Factors on the noise of motion, and on that of measurements.
FACTORS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
#: Whose noise changes: that of the filters, of the world, or of both.
CHANGED = ("filter", "world", "both")

_UNCHANGED = FACTORS.index(1.0)
#: How many numbers the whole page may hold, so that it has at most 100 kB; the shares
#: of the curve, the path, and the ellipses of poses and of landmarks.
_NUMBERS, _SHARES = 30_000, (0.2, 0.3, 0.15, 0.35)
_CODES, _FARTHEST = 2000, 20_000  # codes: of the world's width, and the largest
_OWN_PARTS = Path(__file__).parent / "noise_explorer_parts"
_SCRIPTS = (PARTS / "shapes.js", PARTS / "chart.js", _OWN_PARTS / "explorer.js")


def explore_noise(
    scenario: Scenario,
    estimators: str = "ekf,invariant",
    runs: int = 100,
    seed: int = 0,
    *,
    change: str = "filter",
    progress: Progress = lambda done, total: None,
) -> dict[str, Any]:
    """Run filters with every pair of `FACTORS` on the noise, all on the same seeds.

    Parameters
    ----------
    scenario : Scenario
        The world.
    estimators : str
        Filters, as in ``monte_carlo``.
    runs, seed : int
        As in ``monte_carlo``, for each pair.
    change : {"filter", "world", "both"}
        Whose noise is multiplied.
    progress : callable, optional
        Called with (runs done, all) after every pair.

    Returns
    -------
    dict
        What the page shows, in plain values. The typical run has the median NEES of the
        first filter with the unchanged noise.
    """
    choices = estimator_choices(estimators)
    study = _Exploration(scenario, estimators, choices, runs, seed, change).begun()
    pairs = [(motion, sensor) for sensor in FACTORS for motion in FACTORS]
    studies = 1 + len(pairs)  # the first one has chosen the typical run
    progress(runs, studies * runs)
    cells: list[dict[str, Any]] = []
    for done, pair in enumerate(pairs, 2):
        cells.append(study.cell(*pair))
        progress(done * runs, studies * runs)
    low, high = np.array(average_band(runs, POSE_FREEDOM)) / POSE_FREEDOM
    return {
        "world": scenario.name,
        "runs": runs,
        "steps": scenario.steps,
        "typical": study.typical,
        "change": change,
        "factors": FACTORS,
        "motion": scenario.motion.std,
        "measurement": scenario.sensor.std,
        "units": find_sensor(scenario.sensor.kind).units,
        "filters": [choice.label for choice in choices],
        "band": [round(low, 4), round(high, 4)],
        **study.frame.world(scenario),
        "cells": cells,
    }


class _MapCodes(NamedTuple):
    """How lengths become small integers."""

    low: Array
    #: Length of the sides of the square [m].
    size: float
    landmarks: Array

    @classmethod
    def around(cls, trace: RunTrace, landmarks: Array) -> _MapCodes:
        """Return a square around the truth and the map, with a margin."""
        path = trace.true_poses
        points = [landmarks, trace.poses[:, :2], *([] if path is None else [path])]
        all_points = np.concatenate([each[:, :2] for each in points])
        low, high = np.nanmin(all_points, axis=0), np.nanmax(all_points, axis=0)
        size = 1.3 * float((high - low).max()) + 1e-9
        return cls((low + high - size) / 2, size, landmarks)

    def codes(self, points: Array) -> list[int]:
        """Return the numbers x, y, x, y, … of points (n, 2)."""
        return _small((points - self.low) / self.size)

    def lengths(self, lengths: Array) -> list[int]:
        """Return lengths (n,)."""
        return _small(lengths / self.size)

    def ellipses(self, means: Array, covariances: Array) -> list[int]:
        """Return 3σ ellipses (n): x, y, half axes and the angle of the longer [°]."""
        found: list[int] = []
        for mean, covariance in zip(means, covariances, strict=True):
            values, vectors = np.linalg.eigh(covariance)
            axes = 3 * np.sqrt(np.maximum(values[::-1], 0.0))
            x, y = vectors[:, 1]
            found += self.codes(mean[None]) + self.lengths(axes)
            found.append(round(math.degrees(math.atan2(y, x))) % 180)
        return found

    def world(self, scenario: Scenario) -> dict[str, Any]:
        """Return the landmarks and walls."""
        ends = np.reshape(scenario.walls, (-1, 2))
        return {"landmarks": self.codes(self.landmarks), "walls": self.codes(ends)}


def _small(parts: Array) -> list[int]:
    codes = np.nan_to_num(_CODES * parts, nan=_FARTHEST)
    whole = np.clip(np.round(codes), -_FARTHEST, _FARTHEST).astype(int)
    numbers: list[int] = whole.ravel().tolist()
    return numbers


class _Exploration(NamedTuple):
    """A study of one world."""

    scenario: Scenario
    estimators: str
    choices: Sequence[EstimatorChoice]
    runs: int
    seed: int
    change: str
    #: Seed of the run that the page draws.
    typical: int = 0
    frame: _MapCodes = _MapCodes(np.zeros(2), 1.0, np.zeros((0, 2)))

    def begun(self) -> _Exploration:
        """Choose the typical run, and the part of the plane to show."""
        results = monte_carlo(
            self.scenario, self.estimators, self.runs, self.seed, progress=False
        )
        scores = scores_of(results, self.choices[0].label, "invariant")
        order = scores.ratios("invariant").argsort()
        good = np.flatnonzero(scores.good)
        run = int(good[order[len(order) // 2]]) if len(good) else 0
        study = self._replace(typical=self.seed + run)
        log = study.log_of(self.scenario)
        trace = replayed(log, self.choices[0], self.scenario)
        return study._replace(frame=_MapCodes.around(trace, log.landmarks))

    def cell(self, motion: float, sensor: float) -> dict[str, Any]:
        """Return what the page shows for a pair of factors."""
        scaled = with_noise_times(self.scenario, motion, sensor)
        actual = self.scenario if self.change == "filter" else scaled
        assumed = self.scenario if self.change == "world" else scaled
        results = monte_carlo(
            actual,
            self.estimators,
            self.runs,
            self.seed,
            assumed=assumed,
            progress=False,
        )
        summary = summarise_monte_carlo(results)
        log, filters, truth = self.log_of(actual), [], None
        for choice in self.choices:
            entry = summary["estimators"][choice.label]
            scores = scores_of(results, choice.label, "invariant")
            trace: RunTrace | None = None  # of a run that failed
            if scores.good[self.typical - self.seed]:
                trace = replayed(log, choice, assumed)
                truth = trace.true_poses
            filters.append(
                {
                    "word": entry["verdict"],
                    "reason": entry["reason"],
                    "nees": _rounded(entry["pose_nees"]["invariant"]["mean"]),
                    **self._drawn(scores, trace),
                }
            )
        most = self._counts()[1]
        path = [] if truth is None else self.frame.codes(_thinned(truth[:, :2], most))
        return {"truth": path, "filters": filters}

    def _counts(self) -> list[int]:
        """Return how many points of a curve and a path, and ellipses, to keep."""
        each = _NUMBERS / (len(FACTORS) ** 2 * (len(self.choices) + 0.3))
        sizes = 1, 2, 5, 5
        return [int(each * s / n) for s, n in zip(_SHARES, sizes, strict=True)]

    def _drawn(self, scores: EstimatorScores, trace: RunTrace | None) -> dict[str, Any]:
        """Return the curve of the NEES, and path and ellipses of the typical run."""
        points, poses, ovals, marks = self._counts()
        average = scores.anees("invariant") if scores.good.any() else np.zeros(0)
        curve = np.log10(np.clip(_thinned(average, points), 1e-6, 1e9))
        codes = np.round(100 * curve).astype(int).tolist()
        if trace is None:
            return {"curve": codes, "path": [], "poses": [], "map": []}
        rows = _evenly(len(trace.poses), ovals)
        frame, last = self.frame, trace.map_at(trace.last_step)
        kept = _evenly(len(last.ids), marks)
        position = trace.pose_covariances[rows][:, :2, :2]
        return {
            "curve": codes,
            "path": frame.codes(_thinned(trace.poses[:, :2], poses)),
            "poses": frame.ellipses(trace.poses[rows][:, :2], position),
            "map": frame.ellipses(last.means[kept], last.covariances[kept]),
        }

    def log_of(self, actual: Scenario) -> SlamLog:
        """Drive the typical run in a world."""
        driver = make_controller("open_loop", actual, np.random.default_rng(0))
        return record_episode(actual, driver, self.typical)


def replayed(log: SlamLog, choice: EstimatorChoice, assumed: Scenario) -> RunTrace:
    """Filter a log with the noise of a scenario."""
    slam = choice.settings(assumed).make(log.start)
    return replay(log, slam, name=choice.label).trace


def _evenly(count: int, most: int) -> Array:
    """Return at most ``most`` indices below ``count``, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _thinned(values: Array, most: int) -> Array:
    return np.asarray(values[_evenly(len(values), most)])


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.3g}")


def write_explorer(path: str | Path, facts: Mapping[str, Any]) -> None:
    """Write the page of `explore_noise`; it appears complete or not at all.

    Parameters
    ----------
    path : str or Path
        The .html file; its folder must exist.
    facts : mapping
        What `explore_noise` returns.
    """
    script = "\n".join(part.read_text("utf-8") for part in _SCRIPTS)
    styles = PARTS / "page.css", _OWN_PARTS / "explorer.css"
    cells = json.dumps(facts["cells"], separators=(",", ":")).encode()
    page = page_environment(_OWN_PARTS).get_template("explorer.html")
    text = page.render(
        world=facts["world"],
        filters=", ".join(facts["filters"]),
        runs=facts["runs"],
        typical=facts["typical"],
        change=facts["change"],
        last=len(FACTORS) - 1,
        unchanged=_UNCHANGED,
        style=Markup("".join(part.read_text("utf-8") for part in styles)),
        script=Markup(script),
        script_hash=hash_of(f"\n{script}\n"),
        facts=inline_json({k: v for k, v in facts.items() if k != "cells"}),
        cells=base64.b64encode(zlib.compress(cells, 9)).decode(),
    )
    with replace_when_written(path) as partial:
        partial.write_text(text, encoding="utf-8")
