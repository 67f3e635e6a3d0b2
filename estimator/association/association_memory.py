"""The memory of association between scans, and its model of the sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..support import saved_states
from .missed_detections import Detections
from .nearest_neighbour import Noise
from .tentative_landmarks import TentativeLandmarks
from .unexplained_density import UnexplainedDensity


class Sensor(NamedTuple):
    """The properties of the sensor that association uses."""

    noise: Noise
    min_range: float
    """Readings closer than this have no usable bearing [m]."""

    @classmethod
    def checked(cls, measurement_std: ArrayLike, options: Mapping[str, Any]) -> Sensor:
        """Read a sensor from the arguments of a filter, which has checked them."""
        bearing_std, range_std = np.asarray(measurement_std, dtype=np.float64).tolist()
        names = "range_std_per_metre", "bearing_std_metres"
        noise = Noise(
            bearing_std, range_std, *(float(options.get(n, 0.0)) for n in names)
        )
        return cls(noise, options.get("min_range", 1e-3))


@dataclass(frozen=True)
class Candidates:
    """Landmarks that are not in the map yet, and the next identity to assign."""

    tentative: TentativeLandmarks = field(default_factory=TentativeLandmarks.none)
    """Landmarks without an identity."""
    waiting: Mapping[int, Sequence[int]] = field(default_factory=dict)
    """Given identities that are not trusted yet, and the scans that showed them."""
    next_id: int = 0
    """Above all identities so far."""
    scan: int = 0
    """Number of scans so far."""
    density: UnexplainedDensity = field(default_factory=UnexplainedDensity)
    """Of readings that belong to no landmark of the map."""
    detections: Detections = field(default_factory=Detections.none)
    """Which landmarks the scans have shown; counted for hypotheses only."""

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all, as arrays."""
        waiting = [(i, scan) for i, scans in self.waiting.items() for scan in scans]
        return {
            **{key: value.copy() for key, value in self.tentative._asdict().items()},
            "waiting": np.array(waiting, dtype=np.int64).reshape(-1, 2),
            "next_id": np.array(self.next_id),
            "scan": np.array(self.scan),
            "density": np.array(self.density),
            **self.detections.state_dict(),
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Candidates:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        waiting: dict[int, list[int]] = {}
        pairs = saved_states.whole_numbers(
            "tentative.waiting", state["waiting"], (-1, 2)
        )
        for landmark_id, scan in pairs.tolist():
            waiting.setdefault(landmark_id, []).append(scan)
        density = saved_states.array("tentative.density", state["density"], (4,))
        if density.min() <= 0:
            raise ValueError(f"state['tentative.density'] must be > 0, got {density}")
        return cls(
            TentativeLandmarks.from_state_dict(state),
            waiting,
            saved_states.whole_number("tentative.next_id", state["next_id"]),
            saved_states.whole_number("tentative.scan", state["scan"]),
            UnexplainedDensity(*density.tolist()),
            Detections.from_state_dict(state),
        )
