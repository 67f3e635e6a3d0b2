"""Observations of a belief as a set of landmarks, which no number of landmarks bounds.

Every mapped landmark is one row of features. The rows are a set: their order carries no
identity, and a mask marks those in use, so a policy that treats rows alike can be taken
to floors with more or fewer landmarks.

Symbols
-------
ρ = Rᵀ (l - p)  landmark in the robot's frame [m]
e_l, e_p        errors of landmark and pose in the map, turned into the robot's frame
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from ..arrays import AnyArray, Array, BoolArray, IntArray
from ..estimator.models.bearing_range import wrap_angle_jit
from ..jit import jit, njit_internal
from ..sim_configs.field_types import unknown_choice
from .belief_features import (
    correlation_jit,
    on_log_scale_jit,
    relative_spread,
    root_jit,
    turned_jit,
)

# The columns of ``landmarks``.
FEATURES = (
    "ahead",  # of ρ, squashed
    "aside",
    "std_ahead",  # of ρ, log scale
    "std_aside",
    "correlation",  # of ρ, ahead with aside
    "map_std_ahead",  # of e_l, log scale
    "map_std_aside",
    "map_correlation",  # of e_l, ahead with aside
    "known",  # 1 if it is known to the required accuracy
    "ahead_pose_ahead",  # correlations of e_l with e_p
    "ahead_pose_aside",
    "ahead_pose_heading",
    "aside_pose_ahead",
    "aside_pose_aside",
    "aside_pose_heading",
)

SCALE = 10.0  # s in ρ / (‖ρ‖ + s), which maps all distances into [0, 1) [m]

_ROWS = 32
_KINDS, _PRECISIONS = ("flat", "set"), ("float64", "float32")


@dataclass(frozen=True)
class ObservationForm:
    """The form of the observation: keywords of the environments of active SLAM."""

    # "flat": row i is landmark i. "set": rows in the order of their distance.
    observation: str = "flat"
    # Rows of a set, 32 by default; the nearest landmarks have one.
    max_landmarks: int | None = None
    dtype: str = "float64"  # of the numbers: "float64" or "float32"

    def __post_init__(self) -> None:
        if self.observation not in _KINDS:
            raise ValueError(unknown_choice("observation", self.observation, _KINDS))
        if self.dtype not in _PRECISIONS:
            raise ValueError(unknown_choice("dtype", self.dtype, _PRECISIONS))
        rows = self.max_landmarks
        if rows is None:
            return
        if self.observation == "flat":
            raise ValueError(
                "max_landmarks must be left out unless observation = 'set', "
                f"got {rows!r}"
            )
        if isinstance(rows, bool) or not isinstance(rows, int | np.integer) or rows < 1:
            raise ValueError(f"max_landmarks must be a whole number >= 1, got {rows!r}")

    @property
    def rows(self) -> int:
        """Rows of a set; 0 for a flat observation."""
        return 0 if self.observation == "flat" else self.max_landmarks or _ROWS

    def space(self, flat: spaces.Dict) -> spaces.Dict:
        """Return the space of observations of this form."""
        boxes: dict[str, Any] = dict(flat.spaces)
        if self.rows:
            boxes = {key: box for key, box in boxes.items() if not _is_by_row(key)}
            shape, yes_or_no = (self.rows, len(FEATURES)), np.bool_
            boxes["landmarks"] = spaces.Box(-1.0, 1.0, shape, dtype=np.float64)
            boxes["mask"] = spaces.Box(0, 1, shape[:1], dtype=yes_or_no)
        return spaces.Dict({key: self._box(box) for key, box in boxes.items()})

    def _box(self, box: Any) -> Any:
        if box.dtype == np.bool_ or self.dtype == "float64":
            return box
        low, high = box.low.astype(self.dtype), box.high.astype(self.dtype)
        return spaces.Box(low, high, dtype=np.float32)

    def cast(self, rows: dict[str, AnyArray]) -> dict[str, AnyArray]:
        """Return observations in the order of the space and with its precision."""
        if self.rows:
            rows = {key: rows[key] for key in sorted(rows) if not _is_by_row(key)}
        if self.dtype == "float64":
            return rows
        return {
            key: row if row.dtype == np.bool_ else row.astype(self.dtype)
            for key, row in rows.items()
        }


@jit
def write_landmark_sets(
    worlds: BoolArray,
    beliefs: tuple[Array, Array, IntArray],
    known: BoolArray,
    landmarks: Array,
    mask: BoolArray,
) -> None:
    """Write the landmarks of some worlds, (B,), as sets.

    Parameters
    ----------
    beliefs : tuple
        The arrays of a `BatchStorage`, of B worlds.
    known : bool ndarray, shape (B, N)
        Which landmarks are known accurately enough.
    landmarks : ndarray, shape (B, R, 15)
        For the columns of `FEATURES`. The nearest landmarks come first; rows without
        one are 0.
    mask : bool ndarray, shape (B, R)
        For the rows with a landmark.
    """
    means, covariances, slots = beliefs
    distances = np.empty(slots.shape[1])
    for b in range(len(worlds)):
        if not worlds[b]:
            continue
        mean = means[b]
        for i in range(slots.shape[1]):
            distances[i] = math.inf
            if slots[b, i] >= 0:
                x = 3 + 2 * slots[b, i]
                distances[i] = math.hypot(mean[x] - mean[0], mean[x + 1] - mean[1])
        order = np.argsort(distances, kind="mergesort")
        landmarks[b], mask[b] = 0.0, False
        for row in range(min(len(order), mask.shape[1])):
            i = order[row]
            if slots[b, i] < 0:
                break
            mask[b, row] = True
            x = 3 + 2 * slots[b, i]
            _write_row(mean, covariances[b], x, distances[i], landmarks[b, row])
            landmarks[b, row, 8] = 1.0 if known[b, i] else 0.0


@njit_internal
def _write_row(
    mean: Array, covariance: Array, x: int, distance: float, row: Array
) -> None:
    """Write the features of the landmark at entry x of the state."""
    heading = wrap_angle_jit(mean[2])
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = mean[x] - mean[0], mean[x + 1] - mean[1]
    row[0] = (cos * dx + sin * dy) / (distance + SCALE)
    row[1] = (cos * dy - sin * dx) / (distance + SCALE)
    xx, xy, yy = relative_spread(covariance, x, dx, dy)
    aa, ab, bb = turned_jit(xx, xy, yy, cos, sin)
    ahead, aside = root_jit(aa), root_jit(bb)
    row[2], row[3] = on_log_scale_jit(ahead), on_log_scale_jit(aside)
    row[4] = correlation_jit(ab, ahead * aside)
    P, y = covariance, x + 1
    aa, ab, bb = turned_jit(P[x, x], P[x, y], P[y, y], cos, sin)
    ahead, aside = root_jit(aa), root_jit(bb)
    row[5], row[6] = on_log_scale_jit(ahead), on_log_scale_jit(aside)
    row[7] = correlation_jit(ab, ahead * aside)
    aa, ab, bb = turned_jit(P[0, 0], P[0, 1], P[1, 1], cos, sin)
    pose_ahead, pose_aside, turn = root_jit(aa), root_jit(bb), root_jit(P[2, 2])
    # Rᵀ C R with C the covariance of landmark and position
    left = cos * P[x, 0] + sin * P[y, 0], cos * P[x, 1] + sin * P[y, 1]
    right = cos * P[y, 0] - sin * P[x, 0], cos * P[y, 1] - sin * P[x, 1]
    row[9] = correlation_jit(cos * left[0] + sin * left[1], ahead * pose_ahead)
    row[10] = correlation_jit(cos * left[1] - sin * left[0], ahead * pose_aside)
    row[11] = correlation_jit(cos * P[x, 2] + sin * P[y, 2], ahead * turn)
    row[12] = correlation_jit(cos * right[0] + sin * right[1], aside * pose_ahead)
    row[13] = correlation_jit(cos * right[1] - sin * right[0], aside * pose_aside)
    row[14] = correlation_jit(cos * P[y, 2] - sin * P[x, 2], aside * turn)


def _is_by_row(key: str) -> bool:
    """Return whether an entry of the flat observation has one row per landmark."""
    return key.startswith("belief_landmark") or key == "belief_mask"
