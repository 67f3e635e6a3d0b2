"""Read the estimates of any program: csv, TUM with covariances, or npz.

A file holds one drive and is named after its seed, as ``seed_00000007.csv``; an npz may
hold many. docs/judge.md defines the columns.
"""

import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..arrays import AnyArray, Array, BoolArray, IntArray
from .logs.importers.any_format import read_true_path
from .logs.importers.planar_paths import TUM_SIZES
from .logs.log_lines import (
    LogLine,
    is_number,
    plain_rows,
    read_lines,
    read_text,
    to_lines,
)
from .logs.slamlog import LogError
from .trajectories.manifest import MANIFEST, load_trajectories
from .trajectories.trajectory import BELIEFS, Trajectory, array_of

T = TypeVar("T")


class DriveEstimate(NamedTuple):
    """The estimates of one drive, as in their file."""

    file: str
    #: Shape (T, 3) [m, m, rad].
    poses: Array
    #: Shape (T, 3, 3).
    covariances: Array
    #: Shape (T,); None if pose k is that of step k.
    times: Array | None = None
    #: Whether the times are in seconds, not steps.
    in_seconds: bool = False
    landmark_ids: IntArray = np.zeros(0, np.int64)
    #: Of the final map, shape (n, 2) [m].
    landmarks: Array = np.zeros((0, 2))
    landmark_covariances: Array = np.zeros((0, 2, 2))
    #: Whether the file has covariances of z, roll and pitch, and its poses are not
    #: those of a plane.
    is_spatial: bool = False

    def at(self, rows: IntArray) -> "DriveEstimate":
        """Return the same file with some of its poses only."""
        times = None if self.times is None else self.times[rows]
        poses, covariances = self.poses[rows], self.covariances[rows]
        return self._replace(poses=poses, covariances=covariances, times=times)


def true_path(path: Path) -> Array:
    """Read rows (t, x, y, θ); without times, t counts the poses.

    Times must increase. Rows that repeat the one before them are left out.
    """
    if is_tum(path):
        lines = content_lines(path)
        rows = np.array([row[:8] for row in tum_rows(lines)])
        headings = planar_headings(rows[:, 4:], lines)
        found = np.column_stack([rows[:, :3], headings])
        places = [f"{line.file}, line {line.number}" for line in lines]
    else:
        found = read_true_path(path).rows
        places = [f"{path}, pose {row}" for row in range(len(found))]
    return found[growing_rows(found, places)]


def is_tum(path: Path) -> bool:
    """Whether the first line that is not a comment has the numbers of a row of TUM."""
    lines = content_lines(path) if path.is_file() else []
    fields = lines[0].text.split() if lines else []
    return len(fields) - 8 in TUM_SIZES and all(map(is_number, fields))


def growing_rows(rows: Array, places: Sequence[str]) -> IntArray:
    """Return which rows (t, …) to keep so that times increase; refuse unsorted ones.

    Parameters
    ----------
    rows : ndarray, shape (n, m)
        The time comes first.
    places : sequence of str
        File and line of each row.
    """
    same = (np.diff(rows, axis=0) == 0).all(axis=1)
    kept = np.flatnonzero(np.append(True, ~same))
    times = rows[kept, 0]
    if len(kept) > 1 and (times == times[0]).all():
        raise LogError(
            f"{places[0]}: expected time stamps that grow, got {times[0]:.17g} in all "
            f"{len(kept)} rows; write them with more digits"
        )
    wrong = np.flatnonzero(np.diff(times) <= 0)
    if not len(wrong):
        return kept
    before, late = times[wrong[0]], times[wrong[0] + 1]
    remedy = "write all digits" if late == before else "sort the rows by time"
    raise LogError(
        f"{places[kept[wrong[0] + 1]]}: expected a time stamp after {before:.17g}, got "
        f"{late:.17g}; {remedy}"
    )


_CSV = (
    "pose,t,x,y,θ and 6 or 9 entries of its covariance, or "
    "landmark,id,x,y and 3 or 4 entries of its covariance"
)
_POSE = "pose,"
_TUM = "t x y z qx qy qz qw and 6, 9, 21 or 36 entries of a covariance"
_ENDINGS = (".csv", ".tum", ".txt", ".npz")
_UNIT = 0.1  # largest difference of the length of a quaternion from 1
_TILT = np.pi / 6  # of a robot that has a heading
_GAP = 3.0  # of the truth, in usual intervals of its rows
_CLIMB = 0.05  # and tilt: beyond it, a path is not planar


def read_estimates(paths: Sequence[Path]) -> dict[Any, DriveEstimate]:
    """Read the files of an estimator; a folder stands for the files in it.

    Parameters
    ----------
    paths : sequence of Path
        Files, folders of files, or data sets with the beliefs of a filter.

    Returns
    -------
    dict
        By the seed in the name of a file, as in ``seed_00000007.csv`` or inside an npz;
        by the name without its ending if there is none.

    Raises
    ------
    ValueError
        If a file is malformed, or two belong to one drive.
    """
    found: dict[Any, DriveEstimate] = {}
    for path in paths:
        for name, estimate in _each_estimate(path):
            if name in found:
                raise ValueError(
                    f"{found[name].file} and {estimate.file} are both of drive {name}"
                )
            found[name] = estimate
    if not found:
        raise ValueError(
            f"estimates must be files ending in {', '.join(_ENDINGS)}, got none in "
            f"{', '.join(map(str, paths))}"
        )
    return found


def _each_estimate(path: Path) -> Iterator[tuple[Any, DriveEstimate]]:
    if (path / MANIFEST).is_file():
        for drive in load_trajectories(path):
            yield drive.seed, beliefs_of(drive, str(path))
        return
    for file in files_in([path]):
        if file.suffix == ".npz":
            yield from _of_npz(file)
        else:
            read = _of_csv if file.suffix == ".csv" else _of_tum
            yield name_of(file), read(file)


def paths_by_label(estimates: Any) -> dict[str, list[Path]]:
    """Return paths by the labels of estimators."""

    def paths_in(given: Any) -> list[Path]:
        each = [given] if isinstance(given, str | PathLike) else given
        if not isinstance(each, Iterable):
            raise TypeError(f"estimates must be paths of files, got {given!r}")
        return list(map(Path, each))

    named: dict[str, list[Path]] = {}
    if isinstance(estimates, Mapping):
        named = {str(label): paths_in(each) for label, each in estimates.items()}
    else:
        for path in paths_in(estimates):
            folder = path if path.is_dir() else path.parent
            label = folder.resolve().name or "estimates"
            named.setdefault(label, []).append(path)
    if not named or not all(named.values()):
        raise ValueError("estimates must be at least one file or folder, got none")
    for path in (path for paths in named.values() for path in paths):
        if not path.exists():
            raise ValueError(f"{path} does not exist")
    return named


def files_in(paths: Sequence[Path]) -> list[Path]:
    """List files, and those with a known ending in folders."""
    found: list[Path] = []
    for path in paths:
        inside = path.iterdir() if path.is_dir() else ()
        known = sorted(f for f in inside if f.suffix in _ENDINGS and f.is_file())
        found += known if path.is_dir() else [path]
    return found


def name_of(path: Path) -> Any:
    """Return the seed in the name of a file, or the name."""
    found = re.search(r"seed_?(\d{1,18})", path.stem)
    return int(found[1]) if found else path.stem


def near_truth(times: Array, due: Array) -> BoolArray:
    """Whether times (n,) lie within those of a true path, and in none of its gaps."""
    after = np.clip(np.searchsorted(due, times), 1, len(due) - 1)
    spacing = np.median(np.diff(due))
    nearest = np.minimum(times - due[after - 1], due[after] - times)
    is_gap = (due[after] - due[after - 1] > _GAP * spacing) & (nearest > 0.05 * spacing)
    return np.asarray((times >= due[0]) & (times <= due[-1]) & ~is_gap)


def paired(estimates: dict[Any, T], names: Sequence[Any]) -> dict[Any, T]:
    """Name estimates after their truths: alike, or by what differs between the names.

    ``run1_est`` and ``run2_est`` belong to ``run1_gt`` and ``run2_gt``.
    """
    if set(estimates) & set(names):
        return estimates
    if len(names) == len(estimates) == 1:
        return dict(zip(names, estimates.values(), strict=True))
    true, theirs = _keys(names), _keys(list(estimates))
    by_key = dict(zip(theirs, estimates.values(), strict=True))
    if len(set(true)) < len(true) or len(by_key) < len(estimates):
        return estimates
    pairs = zip(names, true, strict=True)
    return {name: by_key[key] for name, key in pairs if key in by_key} or estimates


def _keys(names: Sequence[Any]) -> list[tuple[str, ...]]:
    """Return the words and numbers of each name that not all of the names have."""
    parts = [re.findall(r"\d+|[^\W\d_]+", str(name).lower()) for name in names]
    plain = [[part.lstrip("0") or "0" for part in each] for each in parts]
    common = set.intersection(*map(set, plain))
    return [tuple(part for part in each if part not in common) for each in plain]


def beliefs_of(drive: Trajectory, file: str) -> DriveEstimate:
    """Return the beliefs that are in a data set beside the truth."""
    if drive.belief_poses is None:
        raise ValueError(
            f"{file} must hold the beliefs of a filter to be judged: it was generated "
            "without --estimator; to judge other estimates, give it as drives"
        )
    beliefs = {name: array_of(drive, name) for name in BELIEFS}
    return _of_arrays(file, beliefs, drive.scenario.sensor.identities)


def _of_arrays(
    file: str, arrays: Mapping[str, AnyArray], is_named: bool = True
) -> DriveEstimate:
    """Return the estimates in arrays of one drive, with the names of a data set."""
    poses, claims = (np.asarray(arrays[name], np.float64) for name in BELIEFS[:2])
    if poses.ndim != 2 or claims.shape != (*poses.shape, 3) or poses.shape[1] != 3:
        raise ValueError(
            f"{file}: {BELIEFS[0]} must be (T, 3) and {BELIEFS[1]} (T, 3, 3) for each "
            f"drive, got {poses.shape} and {claims.shape}"
        )
    estimate = DriveEstimate(file, poses, claims)
    if not is_named or not set(BELIEFS) <= set(arrays):
        return estimate
    places, their, ids = (np.asarray(arrays[name])[-1] for name in BELIEFS[2:])
    there = ids >= 0
    return estimate._replace(
        landmark_ids=ids[there].astype(np.int64),
        landmarks=places[there].astype(np.float64),
        landmark_covariances=their[there].astype(np.float64),
    )


def _of_npz(file: Path) -> Iterator[tuple[Any, DriveEstimate]]:
    """Yield the drives of an npz: one, or those of its array seed."""
    try:
        with file.open("rb") as stream, np.load(stream) as archive:
            known = [name for name in ("seed", *BELIEFS) if name in archive.files]
            arrays = {name: archive[name] for name in known}
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as error:
        reason = "" if isinstance(error, ValueError) else f": {error}"  # of pickles
        raise ValueError(f"{file} is truncated, or no npz{reason}") from None
    lacking = [name for name in BELIEFS[:2] if name not in arrays]
    if lacking:
        raise ValueError(
            f"{file} must hold {' and '.join(BELIEFS[:2])}: no {lacking[0]}"
        )
    if "seed" not in arrays:
        yield name_of(file), _of_arrays(str(file), arrays)
        return
    seeds = np.atleast_1d(arrays.pop("seed"))
    if any(array.shape[:1] != seeds.shape for array in arrays.values()):
        raise ValueError(f"{file}: every array must have a row for each seed")
    for row, seed in enumerate(seeds.tolist()):
        each = {name: array[row] for name, array in arrays.items()}
        yield seed, _of_arrays(str(file), each)


def content_lines(path: Path) -> list[LogLine]:
    """Read the lines of a file that are not comments."""
    return _without_comments(read_lines(path))


def _without_comments(lines: list[LogLine]) -> list[LogLine]:
    return [line for line in lines if not line.text.startswith("#")]


def _of_csv(path: Path) -> DriveEstimate:
    table, lines = _plain_poses(path)
    poses: list[list[float]] = []
    places: dict[int, list[float]] = {}
    for line in lines:
        kind, *fields = (field.strip() for field in line.text.split(","))
        if kind == "pose":
            line.check_count(fields, (10, 13), _CSV)
            poses.append([line.to_real(field) for field in fields])
        elif kind == "landmark":
            line.check_count(fields, (6, 7), _CSV)
            name = line.to_id(fields[0])
            if name in places:
                raise line.error("each landmark once", f"{name} again")
            places[name] = [line.to_real(field) for field in fields[1:]]
        else:
            raise line.error(_CSV, repr(kind))
    if table is None:
        table = _even(path, poses, _CSV)
    of_map = _even(path, list(places.values()), _CSV) if places else np.zeros((0, 5))
    return DriveEstimate(
        str(path),
        table[:, 1:4],
        square(table[:, 4:], 3),
        times=table[:, 0],
        landmark_ids=np.array(list(places), np.int64),
        landmarks=of_map[:, :2],
        landmark_covariances=square(of_map[:, 2:], 2),
    )


def _plain_poses(path: Path) -> tuple[Array | None, list[LogLine]]:
    """Read all poses of a csv at once; return them and the other lines.

    None, and all lines, if each pose has to be read by itself.
    """
    text = read_text(path)
    rows = text.split("\n")
    of_poses = [row[len(_POSE) :] for row in rows if row.startswith(_POSE)]
    table = plain_rows(of_poses, ",") if of_poses else None
    if table is not None and table.shape[1] in (10, 13):
        # Blank lines hold nothing, but count in line numbers.
        rest = "\n".join(["" if row.startswith(_POSE) else row for row in rows])
        lines = _without_comments(to_lines(rest, str(path))) if rest.strip() else []
        if not any(line.text.startswith(_POSE[:-1]) for line in lines):
            return table, lines
    return None, _without_comments(to_lines(text, str(path)))


def tum_row(line: LogLine) -> list[float]:
    """Read the numbers of a row of TUM; its quaternion has length 1."""
    fields = line.text.split()
    line.check_count(fields, tuple(8 + size for size in TUM_SIZES), _TUM)
    numbers = [line.to_real(field) for field in fields]
    if abs((length := float(np.linalg.norm(numbers[4:8]))) - 1) > _UNIT:
        wanted = "a rotation qx qy qz qw of length 1 in the fields 5 to 8"
        raise line.error(wanted, f"one of length {length:.3g}")
    return numbers


def tum_rows(lines: Sequence[LogLine]) -> Array | list[list[float]]:
    """Read rows as :func:`tum_row` does, in less time where all are alike."""
    table = plain_rows([line.text for line in lines])
    if table is None or table.shape[1] - 8 not in TUM_SIZES:
        return [tum_row(line) for line in lines]
    is_unit = abs(np.linalg.norm(table[:, 4:8], axis=1) - 1) <= _UNIT
    return table if is_unit.all() else [tum_row(line) for line in lines]


def tum_table(path: Path) -> tuple[Array, list[LogLine]]:
    """Read the rows of a TUM file with covariances, and their lines."""
    lines = content_lines(path)
    rows = tum_rows(lines)
    if short := [line for line, row in zip(lines, rows, strict=True) if len(row) == 8]:
        raise short[0].error(_TUM, "no covariance")
    return rows if isinstance(rows, np.ndarray) else _even(path, rows, _TUM), lines


def _of_tum(path: Path) -> DriveEstimate:
    table, lines = tum_table(path)
    headings = planar_headings(table[:, 4:8], lines)
    entries = table[:, 8:]
    is_spatial = False
    if entries.shape[1] in (21, 36):  # of x, y, z, roll, pitch, yaw
        whole = square(entries, 6)
        variances = np.einsum("tii->ti", whole)
        if variances.any() and not variances[:, [0, 1, 5]].any():
            raise lines[0].error(
                "a covariance of x, y, z, roll, pitch, yaw",
                "variances of 0 for x, y and yaw; write positions before rotations",
            )
        is_spatial = bool((whole[:, [2, 3, 4], [2, 3, 4]] > 0).all(axis=1).any())
        is_spatial &= _leaves_its_plane(table[:, 1:8])
        entries = whole[:, [0, 1, 5]][:, :, [0, 1, 5]].reshape(-1, 9)
    poses = np.column_stack([table[:, 1:3], headings])
    return DriveEstimate(
        str(path),
        poses,
        square(entries, 3),
        table[:, 0],
        in_seconds=True,
        is_spatial=is_spatial,
    )


def _leaves_its_plane(rows: Array) -> bool:
    """Whether poses (x, y, z, qx, qy, qz, qw) climb or tilt."""
    extent = np.ptp(rows[:, :3], axis=0)
    climbs = extent[2] > _CLIMB * max(extent[:2].max(), 1e-9)
    return bool(climbs or abs(rows[:, 3:5]).max() > _CLIMB / 2)


def planar_headings(quaternions: Array, lines: Sequence[LogLine]) -> Array:
    """Return the yaws of rotations (n, 4) that are nearly about z; refuse others."""
    q = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    tilts = 2 * np.arcsin(np.minimum(np.hypot(q[:, 0], q[:, 1]), 1))
    if len(q) and tilts.max() > _TILT:
        line, degrees = lines[int(tilts.argmax())], np.degrees(tilts.max())
        wanted = "a rotation about z, qx and qy near 0"
        got = f"qx qy qz qw = {' '.join(f'{x:.3g}' for x in q[tilts.argmax()])}"
        if (2 * np.arcsin(np.minimum(np.hypot(q[:, 1], q[:, 2]), 1)) < _TILT).all():
            raise line.error(wanted, f"{got}: qw comes first; write it last")
        raise line.error(
            wanted, f"{got}, tilted by {degrees:.0f}°; --space judges poses in space"
        )
    qx, qy, qz, qw = quaternions.T
    return np.asarray(
        np.arctan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    )


def _even(path: Path, rows: list[list[float]], form: str) -> Array:
    if not rows or len({len(row) for row in rows}) > 1:
        got = "lines of several lengths" if rows else "no pose"
        raise LogError(f"{path}: expected lines {form}, all alike, got {got}")
    return np.array(rows)


def square(entries: Array, size: int) -> Array:
    """Return matrices (T, n, n) of all entries by rows, or of the upper triangle."""
    if entries.shape[1] == size**2:
        return entries.reshape(-1, size, size)
    matrices = np.zeros((len(entries), size, size))
    rows, columns = np.triu_indices(size)
    matrices[:, rows, columns] = matrices[:, columns, rows] = entries
    return matrices
