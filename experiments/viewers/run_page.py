"""Write a run of one or more filters as one web page to play, without network.

`write_run_page` writes the page. `RunFrames` keeps the map, its correlations and the
outcomes of the readings during a replay, and `PackedArrays` makes them short text.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ...arrays import AnyArray, Array, IntArray
from ...envs.rendering.render_state import drawn_readings
from ...estimator.interface import (
    MapView,
    SlamEstimator,
    UpdateReport,
    joins_its_map,
    view_map,
)
from ...evaluation.hypothesis_tests import chi_square_limits
from ...sim_configs.scenario_files import replace_when_written
from ..figures.accuracy import nis_band
from ..figures.style import deviations, page_environment
from ..logs.ground_truth import true_ids_of
from ..logs.recording import steps_of
from ..logs.slamlog import Scan, SlamLog
from ..run_and_replay.log_replay import ThinnedSteps
from ..run_and_replay.summary import pose_nees
from ..run_and_replay.trace import RunTrace

PARTS = Path(__file__).parent / "run_page_parts"
_SCRIPTS = ("data.js", "shapes.js", "map.js", "chart.js", "player.js")
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
    script = "\n".join((PARTS / name).read_text("utf-8") for name in _SCRIPTS)
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
    template = page_environment(PARTS).get_template("page.html")
    return template.render(
        title=f"{log.name}: {', '.join(names)}",
        notes=_notes(steps, runs),
        several=len(runs) > 1,
        style=Markup((PARTS / "page.css").read_text("utf-8")),
        script=Markup(script),
        script_hash=hash_of(f"\n{script}\n"),
        facts=inline_json(facts),
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
    found, ids = zip(*(_readings(scans[step]) for step in steps), strict=True)
    kind = log.header.get("sensor", "bearing_range")
    rows = [drawn_readings(kind, readings) for readings in found]
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
    """Pack the beliefs of one filter, and the true positions of its landmarks."""
    trace, maps = run.trace, [map_at(run, step) for step in steps]
    _pack_poses(packed, prefix, trace, steps)
    packed.put_frames(f"{prefix}id", [frame.ids for frame in maps], "int32")
    _pack_maps(packed, prefix, maps)
    packed.put_frames(f"{prefix}outcome", [frame.outcomes for frame in maps], "uint8")
    packed.put_frames(f"{prefix}row_id", [frame.row_ids for frame in maps], "int32")
    _pack_correlations(packed, prefix, run.frames, steps)
    packed.put(f"{prefix}final.id", trace.landmark_ids, "int32")
    truth = trace.true_landmarks
    if truth is None:
        truth = np.full((len(trace.landmark_ids), 2), np.nan)
    packed.put(f"{prefix}final.x", truth[:, 0], "float32")
    packed.put(f"{prefix}final.y", truth[:, 1], "float32")


def _pack_maps(packed: PackedArrays, prefix: str, maps: Sequence[MapFrame]) -> None:
    """Pack means and covariances of the landmarks."""
    for axis, name in enumerate("xy"):
        means = [position_codes(frame.means[:, axis]) for frame in maps]
        packed.put_frames(f"{prefix}{name}", means, "int32")
        std = [deviation_codes(deviations(kept.covariances)[:, axis]) for kept in maps]
        packed.put_frames(f"{prefix}std_{name}", std, "int16")
    rho = [np.round(_rho(frame.covariances) * 32000) for frame in maps]
    packed.put_frames(f"{prefix}rho", rho, "int16")


def _pack_poses(
    packed: PackedArrays, prefix: str, trace: RunTrace, steps: Sequence[int]
) -> None:
    """Pack poses, NEES of the pose by 3, and NIS by its degrees of freedom."""
    poses, covariances = trace.poses[steps], trace.pose_covariances[steps]
    std = deviations(covariances)
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


def _rho(covariances: Array) -> Array:
    """Return the correlation of x and y, 0 where one is certain."""
    std = deviations(covariances)
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
                f"{MOST_CORRELATED} landmarks."
            )
        elif len(kept) < len(steps):
            notes.append(
                f"Correlations of {trace.estimator} are those of one step in "
                f"{_stride(kept)}."
            )
    return notes


def _stride(steps: Sequence[int]) -> int:
    return steps[1] - steps[0] if len(steps) > 1 else 1


def hash_of(script: str) -> str:
    """Return the hash by which the page's policy allows this script and no other."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


def inline_json(value: Any) -> Markup:
    """Write JSON that cannot end the script element around it."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c"))


#: What became of a reading; its code is the place in this list.
OUTCOMES = (
    *("not used", "used", "new", "rejected"),
    *("too close to be used", "tentative", "ambiguous"),
)
#: In place of the landmark of a reading that was given to none.
NO_ID = -1
#: Landmarks of the largest map whose correlations are kept.
MOST_CORRELATED = 300

_UNUSED, _USED, _NEW, _REJECTED, _SKIPPED, _TENTATIVE, _AMBIGUOUS = range(7)
_MOST_FRAMES = 2000
_MOST_LANDMARKS = 400_000  # summed over the frames
_MOST_PAIRS = 2_000_000  # summed over the frames with correlations


class MapFrame(NamedTuple):
    """The map after one step, and what became of the scan's readings."""

    #: Landmarks, shape (n,).
    ids: IntArray
    #: Shape (n, 2) [m].
    means: Array
    #: Shape (n, 2, 2) [m²].
    covariances: Array
    #: Of each reading, its place in `OUTCOMES`, shape (m,).
    outcomes: NDArray[np.uint8]
    #: The mapped landmark of each reading, or `NO_ID`, shape (m,).
    row_ids: IntArray


class CorrelationFrame(NamedTuple):
    """The correlations after one step: of the robot's position and n landmarks."""

    #: Landmarks, shape (n,).
    ids: IntArray
    #: In [0, 1]: of row 1 with column 0, 2 with 0, 2 with 1, …, shape (n (n + 1) / 2,).
    #: The robot is row 0.
    values: Array


class RunFrames:
    """Watch a replay, and keep what a viewer shows of it, within bounded memory.

    A long run, or one with a large map, keeps evenly spaced steps, and fewer of them
    with correlations. Maps above `MOST_CORRELATED` landmarks keep no correlations.

    Parameters
    ----------
    log : SlamLog
        The log that is replayed.

    Examples
    --------
    >>> from slamgym.estimator import make_estimator
    >>> from slamgym.experiments.run_and_replay import replay
    >>> log = SlamLog("one scan", events=(Scan(0, [(0.0, 5.0), (1.0, 4.0)], [4, 9]),))
    >>> frames = RunFrames(log)
    >>> slam = make_estimator("ekf", motion_std=(0.1,) * 3, measurement_std=(0.1, 0.1))
    >>> trace = replay(log, slam, watch=frames.watch).trace
    >>> frames.maps[0].ids, frames.correlations[0].values
    (array([4, 9]), array([0., 0., 0.]))
    """

    def __init__(self, log: SlamLog) -> None:
        self._scans = [step.scan for step in steps_of(log)]
        last = len(self._scans) - 1
        self._maps = ThinnedSteps[MapFrame](_MOST_FRAMES, _MOST_LANDMARKS, last)
        self._pairs = ThinnedSteps[CorrelationFrame](_MOST_FRAMES, _MOST_PAIRS, last)
        #: Landmarks of the largest map.
        self.largest = 0
        #: Whether the filter joins its map on demand; then the frames hold no map.
        self.joins = False

    @property
    def maps(self) -> dict[int, MapFrame]:
        """The kept maps by their steps, the first and the last one among them."""
        return self._maps.items

    @property
    def correlations(self) -> dict[int, CorrelationFrame]:
        """The kept correlations by their steps; empty where a map is too large."""
        return {} if self.largest > MOST_CORRELATED else self._pairs.items

    def watch(
        self, step: int, slam: SlamEstimator, report: UpdateReport | None
    ) -> None:
        """Keep a step, if it is due; pass this as ``watch`` of ``replay``."""
        if not self._maps.is_due(step):
            return
        self.joins = joins_its_map(slam)
        outcomes = row_outcomes(self._scans[step], report)
        if self.joins:
            empty = np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2))
            self._maps.put(step, MapFrame(*empty, *outcomes), 1)
            return
        view = view_map(slam)
        ids = np.array(view.ids, dtype=np.int64)
        maps = ids, view.landmarks.copy(), view.landmark_covariances
        self._maps.put(step, MapFrame(*maps, *outcomes), len(ids) + 1)
        self.largest = max(self.largest, len(ids))
        if self.largest <= MOST_CORRELATED and self._pairs.is_due(step):
            values = correlations_of(view)
            self._pairs.put(step, CorrelationFrame(ids, values), len(values) + 1)


def row_outcomes(
    scan: Scan | None, report: UpdateReport | None
) -> tuple[NDArray[np.uint8], IntArray]:
    """Return what became of each reading of a scan, and its landmark in the map.

    Returns
    -------
    outcomes : ndarray of uint8, shape (m,)
        Places in `OUTCOMES`.
    row_ids : ndarray of int, shape (m,)
        `NO_ID` where the filter gave a reading to no landmark.
    """
    rows = 0 if scan is None else len(scan.measurements)
    if scan is None or report is None:
        return np.zeros(rows, np.uint8), np.full(rows, NO_ID)
    ids = _landmark_of_rows(scan, report)
    by_id = dict.fromkeys(report.added_ids, _NEW)
    by_id |= dict.fromkeys(report.rejected_ids, _REJECTED)
    by_id |= dict.fromkeys(report.skipped_ids, _SKIPPED)
    known = np.array([NO_ID if i is None else i for i in ids], np.int64)
    codes = np.array([by_id.get(i, _USED) for i in known.tolist()], np.uint8)
    codes[known == NO_ID] = _UNUSED
    codes[list(report.tentative_rows)] = _TENTATIVE
    codes[list(report.ambiguous_rows)] = _AMBIGUOUS
    return codes, known


def correlations_of(view: MapView) -> Array:
    """Return how strongly the positions of robot and landmarks are correlated.

    For two positions a and b, ρ is their largest canonical correlation: the largest
    correlation between a coordinate of a and one of b, over all directions ::

        ρ = σ₁(Lₐ⁻¹ Pₐᵦ Lᵦ⁻ᵀ),    Lₐ Lₐᵀ = Pₐₐ

    Parameters
    ----------
    view : MapView
        The belief over the pose and n landmarks.

    Returns
    -------
    ndarray, shape (n (n + 1) / 2,)
        As in `CorrelationFrame`; 0 where a position is certain.
    """
    count = 1 + len(view.ids)
    at, own, one, other = _places_of(count)
    blocks = np.asarray(view.covariance)[at].reshape(count, 2, count, 2)
    whiten = _inverse_factors(blocks[own, :, own, :])
    white = whiten[one] @ blocks[one, :, other, :] @ whiten[other].transpose(0, 2, 1)
    return np.minimum(_largest_singular_values(white), 1.0)


@lru_cache(maxsize=8)
def _places_of(count: int) -> tuple[Any, IntArray, IntArray, IntArray]:
    """Return the indices of positions in P, their numbers, and those of all pairs."""
    columns = np.r_[0, 1, 3 : 1 + 2 * count]
    return np.ix_(columns, columns), np.arange(count), *np.tril_indices(count, -1)


def _landmark_of_rows(scan: Scan, report: UpdateReport) -> Sequence[int | None]:
    rows = len(scan.measurements)
    if len(report.row_ids) == rows:
        return report.row_ids
    if scan.landmark_ids is None:
        return (NO_ID,) * rows
    return tuple(scan.landmark_ids.tolist())


def _inverse_factors(P: Array) -> Array:
    """Return L⁻¹ of L Lᵀ = P, shape (n, 2, 2); zeros where P is singular."""
    inverse = np.zeros_like(P)
    a, b = P[:, 0, 0], P[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        first = 1 / np.sqrt(a)
        second = 1 / np.sqrt(P[:, 1, 1] - b * b / a)
        inverse[:, 0, 0], inverse[:, 1, 1] = first, second
        inverse[:, 1, 0] = -b / a * second
    inverse[~np.isfinite(inverse).all(axis=(1, 2))] = 0.0
    return inverse


def _largest_singular_values(A: Array) -> Array:
    """Return σ₁ of 2 × 2 matrices, shape (n,), in closed form."""
    (a, b), (c, d) = A[:, 0].T, A[:, 1].T
    return np.asarray((np.hypot(a + d, c - b) + np.hypot(a - d, c + b)) / 2)


# --------------------------------------------------------------------------------------
# Pack many arrays into one short text inside a web page.
#
# The arrays become integers or single-precision numbers. Arrays of successive frames
# hold differences to the frame before, which deflate shrinks; ``data.js`` unpacks them.

#: Positions are integers of a tenth of a millimetre.
TENTHS = 1e4
#: Standard deviations σ are integers of 2000 ln σ, a resolution of 0.05 %.
LOG_STEPS = 2000.0

_ALIGNMENT = 4  # [bytes] of the page's typed arrays
_TYPES = ("float32", "int32", "int16", "uint8")


class PackedArrays:
    """Arrays by name, collected for one page.

    Examples
    --------
    >>> packed = PackedArrays()
    >>> packed.put("t", np.array([0.0, 0.5]), "float32")
    >>> packed.put_frames("ids", [np.array([4]), np.array([4, 9])], "int32")
    >>> packed.table["ids"]
    {'type': 'int32', 'length': 3, 'counts': 'ids.counts'}
    """

    def __init__(self) -> None:
        #: Type, length and, of frames, the name of their numbers of entries.
        self.table: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []

    def put(self, name: str, values: AnyArray, kind: str) -> None:
        """Add a flat array as one of float32, int32, int16, uint8."""
        if kind not in _TYPES:
            raise ValueError(f"kind must be one of {', '.join(_TYPES)}, got {kind!r}")
        flat = np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<"))
        self.table[name] = {"type": kind, "length": flat.size}
        content = flat.tobytes()
        self._parts.append(content + bytes(-len(content) % _ALIGNMENT))

    def put_frames(self, name: str, frames: Sequence[AnyArray], kind: str) -> None:
        """Add flat arrays of one integer type, one a frame, of any lengths each."""
        counts = f"{name}.counts"
        self.put(counts, np.array([len(frame) for frame in frames]), "int32")
        before = np.empty(0, dtype=kind)
        changes = [before]
        for frame in frames:
            now = np.asarray(frame, dtype=kind)
            change = now.copy()
            common = min(len(now), len(before))
            change[:common] -= before[:common]  # modulo 2ⁿ, as the page adds up
            changes.append(change)
            before = now
        self.put(name, np.concatenate(changes), kind)
        self.table[name]["counts"] = counts

    def text(self) -> str:
        """Return all arrays in the order of the table, deflated, in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts))).decode()


def position_codes(metres: Array) -> AnyArray:
    """Return positions as integers, :data:`TENTHS` a metre; nan is the least one."""
    least, most = np.iinfo(np.int32).min, np.iinfo(np.int32).max
    codes = np.clip(np.round(metres * TENTHS), least + 1, most)
    return np.where(np.isnan(codes), least, codes).astype(np.int32)


def deviation_codes(std: Array) -> AnyArray:
    """Return 2000 ln σ as integers; zero and nan are the least one."""
    least, most = np.iinfo(np.int16).min, np.iinfo(np.int16).max
    with np.errstate(divide="ignore", invalid="ignore"):
        codes = np.clip(np.round(LOG_STEPS * np.log(std)), least, most)
    return np.where(np.isnan(codes), least, codes).astype(np.int16)


class ViewedRun(NamedTuple):
    """One filter's run over the log of the page."""

    #: Its beliefs; its name labels the filter.
    trace: RunTrace
    #: What it watched of the same replay.
    frames: RunFrames


def shown_steps(frames: Sequence[RunFrames]) -> list[int]:
    """Return the steps that all filters have kept, in ascending order."""
    return sorted(set.intersection(*(set(kept.maps) for kept in frames)))


def map_at(run: ViewedRun, step: int) -> MapFrame:
    """Return the map of a step; of a filter that joins its map, the last joined one."""
    frame = run.frames.maps[step]
    if not run.frames.joins:
        return frame
    ids, means, covariances = run.trace.map_at(step)
    return frame._replace(
        ids=ids.astype(np.int64), means=means, covariances=covariances
    )
