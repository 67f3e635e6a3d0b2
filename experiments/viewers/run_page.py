"""Write a run of one or more filters as one web page to play, without network."""

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ...arrays import Array, IntArray
from ...evaluation.hypothesis_tests import chi_square_limits
from ...sim_configs.atomic_file import replace_when_written
from ..figures.consistency import nis_band
from ..figures.web_style import page_template
from ..logs.anonymous import true_ids_of
from ..logs.events import Scan
from ..logs.slamlog import SlamLog
from ..logs.steps import steps_of
from ..runs.summary import pose_nees
from ..runs.trace import RunTrace
from . import run_frames
from .packed_arrays import PackedArrays, deviation_codes, position_codes
from .run_frames import OUTCOMES, MapFrame, RunFrames
from .viewed_run import ViewedRun, map_at, shown_steps

_PARTS = Path(__file__).parent / "run_page_parts"
_SCRIPTS = ("data.js", "map.js", "chart.js", "player.js")
_SHARE = 0.95  # probability of the bands of NEES and NIS


def write_run_page(
    path: str | Path,
    log: SlamLog,
    runs: Sequence[ViewedRun],
    *,
    walls: Iterable[Sequence[float]] = (),
) -> None:
    """Write a page that plays one log, filtered by one or more filters side by side.

    The page is one file that asks the network for nothing. It appears complete or not
    at all; the same runs give the same bytes.

    Parameters
    ----------
    path : str or Path
        The .html file; its folder must exist.
    log : SlamLog
        The log.
    runs : sequence of ViewedRun
        Its replays, at least one.
    walls : iterable of (x0, y0, x1, y1)
        Walls of the world [m].

    Raises
    ------
    ValueError
        If there is no run.
    FileNotFoundError
        If the folder does not exist.
    """
    if not runs:
        raise ValueError("runs must hold at least one run, got none")
    page = _page(log, runs, [list(map(float, wall)) for wall in walls])
    with replace_when_written(path) as partial:
        partial.write_text(page, encoding="utf-8")


def _page(log: SlamLog, runs: Sequence[ViewedRun], walls: list[list[float]]) -> str:
    steps = shown_steps([run.frames for run in runs])
    packed = PackedArrays()
    _pack_world(packed, log, runs[0].trace, steps)
    for number, run in enumerate(runs):
        _pack_filter(packed, f"{number}.", run, steps)
    script = "\n".join((_PARTS / name).read_text("utf-8") for name in _SCRIPTS)
    names = [run.trace.estimator for run in runs]
    facts = {
        "filters": names,
        "unit": runs[0].trace.time_unit,
        "last": runs[0].trace.last_step,
        "outcomes": OUTCOMES,
        "walls": walls,
        "bands": {"nees": [q / 3 for q in chi_square_limits(3, (1 - _SHARE) / 2)]},
        "arrays": packed.table,
    }
    return page_template(_PARTS, "page.html").render(
        title=f"{log.name}: {', '.join(names)}",
        notes=_notes(steps, runs),
        several=len(runs) > 1,
        style=Markup((_PARTS / "page.css").read_text("utf-8")),
        script=Markup(script),
        script_hash=_hash(f"\n{script}\n"),
        facts=_inline_json(facts),
        arrays=packed.text(),
    )


def _pack_world(
    packed: PackedArrays, log: SlamLog, trace: RunTrace, steps: Sequence[int]
) -> None:
    """Pack the steps, the truth and the readings."""
    scans = [step.scan for step in steps_of(log)]
    packed.put("step", np.array(steps), "int32")
    packed.put("t", trace.t[steps], "float32")
    truth = np.full((len(steps), 3), np.nan)
    if trace.true_poses is not None:
        truth = trace.true_poses[steps]
    for name, column in zip(("x", "y", "theta"), truth.T, strict=True):
        packed.put(f"true.{name}", column, "float32")
    packed.put("landmark.id", log.landmark_ids, "int32")
    packed.put("landmark.x", log.landmarks[:, 0], "float32")
    packed.put("landmark.y", log.landmarks[:, 1], "float32")
    rows, ids = zip(*(_readings(scans[step]) for step in steps), strict=True)
    packed.put_frames("reading.true", ids, "int32")
    bearings = [np.round(readings[:, 0] * 1e4) for readings in rows]
    packed.put_frames("reading.bearing", bearings, "int32")
    packed.put_frames("reading.range", [position_codes(r[:, 1]) for r in rows], "int32")


def _readings(scan: Scan | None) -> tuple[Array, IntArray]:
    """Return the readings of a step (m, 2) and their true ids, -2 where unknown."""
    if scan is None:
        return np.empty((0, 2)), np.empty(0, np.int64)
    unknown = np.full(len(scan.measurements), -2)
    ids = true_ids_of(scan)
    return scan.measurements, unknown if ids is None else ids


def _pack_filter(
    packed: PackedArrays, prefix: str, run: ViewedRun, steps: Sequence[int]
) -> None:
    """Pack the beliefs of one filter."""
    trace, maps = run.trace, [map_at(run, step) for step in steps]
    _pack_poses(packed, prefix, trace, steps)
    packed.put_frames(f"{prefix}id", [frame.ids for frame in maps], "int32")
    _pack_maps(packed, prefix, maps)
    packed.put_frames(f"{prefix}outcome", [frame.outcomes for frame in maps], "uint8")
    packed.put_frames(f"{prefix}row_id", [frame.row_ids for frame in maps], "int32")
    _pack_correlations(packed, prefix, run.frames, steps)
    _pack_true_map(packed, prefix, trace)


def _pack_maps(packed: PackedArrays, prefix: str, maps: Sequence[MapFrame]) -> None:
    """Pack means and covariances of the landmarks."""
    for axis, name in enumerate("xy"):
        means = [position_codes(frame.means[:, axis]) for frame in maps]
        packed.put_frames(f"{prefix}{name}", means, "int32")
        std = [deviation_codes(_std(frame.covariances)[:, axis]) for frame in maps]
        packed.put_frames(f"{prefix}std_{name}", std, "int16")
    rho = [np.round(_rho(frame.covariances) * 32000) for frame in maps]
    packed.put_frames(f"{prefix}rho", rho, "int16")


def _pack_true_map(packed: PackedArrays, prefix: str, trace: RunTrace) -> None:
    """Pack the true positions of the landmarks in a filter's map."""
    packed.put(f"{prefix}final.id", trace.landmark_ids, "int32")
    truth = trace.true_landmarks
    if truth is None:
        truth = np.full((len(trace.landmark_ids), 2), np.nan)
    packed.put(f"{prefix}final.x", truth[:, 0], "float32")
    packed.put(f"{prefix}final.y", truth[:, 1], "float32")


def _pack_poses(
    packed: PackedArrays, prefix: str, trace: RunTrace, steps: Sequence[int]
) -> None:
    """Pack poses, NEES of the pose by 3, and NIS by its degrees of freedom."""
    poses, covariances = trace.poses[steps], trace.pose_covariances[steps]
    std = _std(covariances)
    for k, name in enumerate(("x", "y", "theta")):
        packed.put(f"{prefix}pose.{name}", poses[:, k], "float32")
        packed.put(f"{prefix}pose.std_{name}", std[:, k], "float32")
    packed.put(f"{prefix}pose.rho", _rho(covariances), "float32")
    packed.put(f"{prefix}nees", pose_nees(trace)[steps] / 3, "float32")
    dof = trace.nis_dof[steps]
    known = np.where(dof > 0, dof, np.nan)
    packed.put(f"{prefix}nis", trace.nis[steps] / known, "float32")
    for name, bound in zip(("low", "high"), nis_band(dof, _SHARE), strict=True):
        packed.put(f"{prefix}nis_{name}", bound / known, "float32")


def _pack_correlations(
    packed: PackedArrays, prefix: str, frames: RunFrames, steps: Sequence[int]
) -> None:
    """Pack the correlations of the shown steps that have some, as 255 ρ."""
    places = {step: place for place, step in enumerate(steps)}
    kept = {k: found for k, found in frames.correlations.items() if k in places}
    packed.put(f"{prefix}pairs.place", np.array([places[k] for k in kept]), "int32")
    ids = [found.ids for found in kept.values()]
    packed.put_frames(f"{prefix}pairs.id", ids, "int32")
    values = [np.round(255 * found.values) for found in kept.values()]
    packed.put_frames(f"{prefix}pairs.value", values, "uint8")


def _std(covariances: Array) -> Array:
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def _rho(covariances: Array) -> Array:
    """Return the correlation of x and y, 0 where one is certain."""
    std = _std(covariances)
    scale = std[:, 0] * std[:, 1]
    known = np.isfinite(scale) & (scale > 0)
    rho = np.divide(covariances[:, 0, 1], scale, out=np.zeros(len(std)), where=known)
    return np.asarray(np.clip(np.nan_to_num(rho), -1.0, 1.0))


def _notes(steps: Sequence[int], runs: Sequence[ViewedRun]) -> list[str]:
    """Say what the page leaves out of a long run or a large map."""
    notes = []
    last = runs[0].trace.last_step
    if len(steps) <= last:
        notes.append(f"The page holds one step in {_stride(steps)} of {last}.")
    for trace, frames in runs:
        kept = [k for k in steps if k in frames.correlations]
        if frames.joins:
            notes.append(
                f"{trace.estimator} joins its map only sometimes: the page shows the "
                "last joined map, without correlations."
            )
        elif not kept:
            notes.append(
                f"Correlations are omitted: {trace.estimator} has more than "
                f"{run_frames.MOST_CORRELATED} landmarks."
            )
        elif len(kept) < len(steps):
            notes.append(
                f"Correlations of {trace.estimator} are those of one step in "
                f"{_stride(kept)}."
            )
    return notes


def _stride(steps: Sequence[int]) -> int:
    return steps[1] - steps[0] if len(steps) > 1 else 1


def _hash(script: str) -> str:
    """Return the hash by which the page's policy allows this script and no other."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


def _inline_json(value: Any) -> Markup:
    """Write JSON that cannot end the script element around it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c"))
