"""The policy that decides when landmarks enter a map, are merged, and are removed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from math import inf, isfinite, pi, sqrt
from typing import Any

import numpy as np

from ... import argument_checks
from ...arrays import Array, BoolArray
from ...suggestions import closest
from ..association.constellations import Constellations
from ..association.scan_assignments import AssociationPolicy
from ..models.bearing_range import wrap_angle


@dataclass(frozen=True)
class LandmarkPolicy(AssociationPolicy):
    """Settings of landmark management, for the argument ``management`` of any filter.

    The default associates readings without identity and confirms new landmarks before
    they enter the map; it removes and merges none.

    Raises
    ------
    ValueError
        If a value is out of range, or two contradict each other.

    Examples
    --------
    >>> from slamgym.estimator import make_estimator
    >>> slam = make_estimator(
    ...     "invariant",
    ...     motion_std=(0.1, 0.1, 0.05),
    ...     measurement_std=(0.02, 0.1),
    ...     management=LandmarkPolicy(confirm=(2, 3)),
    ... )
    >>> slam.update([(0.0, 5.0)]).added_ids  # without identity
    ()
    >>> slam.update([(0.01, 5.1)]).confirmed_ids
    (0,)
    """

    #: Field of view of the sensor; required by ``remove_after``.
    view: FieldOfView | None = None
    #: Remove a landmark missed in this many scans since it was last seen.
    remove_after: int | None = None
    #: Smallest distance of two landmarks [m]; landmarks estimated closer are merged.
    merge_within: float | None = None
    #: Largest Dᵀ C⁻¹ D, of the offset D, at which two landmarks may be one.
    merge_gate: float = 9.21
    #: How landmarks around the robot are recognised as older ones after long drift;
    #: None: never.
    constellations: Constellations | None = field(default_factory=Constellations)
    #: Largest number of landmarks; beyond it the least informative are removed.
    capacity: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        argument_checks.above("merge_gate", self.merge_gate, 0.0)
        for name in ("remove_after", "capacity"):
            if getattr(self, name) is not None:
                argument_checks.whole(name, getattr(self, name), 1)
        if self.merge_within is not None:
            argument_checks.above("merge_within", self.merge_within, 0.0)
        if not isinstance(self.constellations, Constellations | None):
            raise ValueError(
                "constellations must be Constellations or None (management= also takes "
                f"its fields as a mapping, and True), got {self.constellations!r}"
            )
        if not isinstance(self.view, FieldOfView | None):
            raise ValueError(f"view must be a FieldOfView or None, got {self.view!r}")
        if self.remove_after is not None and self.view is None:
            raise ValueError(
                "view must be given with remove_after: it determines which landmarks "
                "a scan should show"
            )

    def reach(self, readings: Array) -> float:
        """Return the distance within which a landmark may matter for a scan [m]."""
        ranges: list[float] = readings[:, 1].tolist()
        reach = max([0.0, *filter(isfinite, ranges)])
        if self.remove_after is not None and self.view is not None:
            reach = max(reach, self.view.max_range)
        return reach + (self.merge_within or 0.0)

    @property
    def worst_separation_std(self) -> float:
        """Largest σ of an offset at which two landmarks can be distinguished [m].

        Two landmarks at the distance ``merge_within`` must fail the test in 99.8 % of
        cases: their offset, less 3 σ, must still lie outside the gate.
        """
        return (self.merge_within or 0.0) / (sqrt(self.merge_gate) + 3.0)


def as_policy(value: LandmarkPolicy | Mapping[str, Any] | bool) -> LandmarkPolicy:
    """Return a policy, given as such, by its fields, or as True for the default.

    Raises
    ------
    ValueError
        If the value is none of these, or names an unknown field.

    Examples
    --------
    >>> as_policy({"confirm": [2, 3], "view": {"max_range": 8}}).view.max_range
    8
    """
    if isinstance(value, LandmarkPolicy):
        return value
    if value is True:
        return LandmarkPolicy()
    if not isinstance(value, Mapping):
        raise ValueError(
            "management must be a LandmarkPolicy, its fields as a mapping, or True, "
            f"got {value!r}"
        )
    given = dict(value)
    if isinstance(given.get("constellations"), bool):
        given["constellations"] = {} if given["constellations"] else None
    for name, kind in (("view", FieldOfView), ("constellations", Constellations)):
        if isinstance(part := given.get(name), Mapping):
            given[name] = _made(kind, f"management.{name}", part)
    policy: LandmarkPolicy = _made(LandmarkPolicy, "management", given)
    return policy


def policy_of(slam: object) -> LandmarkPolicy:
    """Return the policy of an estimator; the default where it has none."""
    policy = getattr(slam, "policy", None)
    return policy if isinstance(policy, LandmarkPolicy) else LandmarkPolicy()


@dataclass(frozen=True)
class FieldOfView:
    """The field of view of a sensor, and what may hide a landmark in it.

    A scan is expected to show a landmark that lies inside the limits by a margin, is
    not hidden, and is not behind another reading.

    Raises
    ------
    ValueError
        If a limit is not a number, or the field of view is empty.

    Examples
    --------
    >>> ahead = FieldOfView(max_range=8.0, angle=np.pi)
    >>> landmarks = np.array([[5.0, 1.0], [-5.0, 1.0], [9.0, 0.0]])
    >>> ahead.expects(np.zeros(3), landmarks, np.empty((0, 2))).tolist()
    [True, False, False]
    """

    #: Largest range [m].
    max_range: float
    #: Smallest range [m].
    min_range: float = 0.0
    #: Full angle, centred on the heading [rad].
    angle: float = 2 * pi
    #: Landmarks nearer than this to a range limit are not expected [m].
    range_margin: float = 0.5
    #: Landmarks nearer than this to an edge of the angle are not expected [rad].
    bearing_margin: float = 0.05
    #: A landmark within this angle of a nearer reading may be hidden by it [rad].
    shadow: float = 0.0
    #: Function of a pose (3,) and landmarks (n, 2): True, shape (n,), if not hidden.
    visible: Visibility | None = None

    def __post_init__(self) -> None:
        for name in ("min_range", "range_margin", "bearing_margin", "shadow"):
            argument_checks.at_least(name, getattr(self, name), 0.0)
        if self.max_range != inf:
            argument_checks.above("max_range", self.max_range, self.min_range)
        argument_checks.above("angle", self.angle, 0.0)
        if self.angle > 2 * pi:
            raise ValueError(f"angle must be at most 2π, got {self.angle!r}")
        if self.visible is not None and not callable(self.visible):
            raise ValueError(f"visible must be callable or None, got {self.visible!r}")

    def expects(self, pose: Array, landmarks: Array, readings: Array) -> BoolArray:
        """Return which landmarks a scan should show.

        Parameters
        ----------
        pose : ndarray, shape (3,)
            Pose (x, y, θ) of the scan [m, m, rad].
        landmarks : ndarray, shape (n, 2)
            Estimated positions [m].
        readings : ndarray, shape (m, 2)
            The scan, rows (β, r) [rad, m], which may hide landmarks behind them.

        Returns
        -------
        ndarray of bool, shape (n,)
        """
        dx, dy = (landmarks - pose[:2]).T
        distance = np.hypot(dx, dy)
        bearing = wrap_angle(np.arctan2(dy, dx) - pose[2])
        expected = distance <= self.max_range - self.range_margin
        if self.min_range > 0:
            expected &= distance >= self.min_range + self.range_margin
        if self.angle < 2 * pi:
            expected &= np.abs(bearing) <= self.angle / 2 - self.bearing_margin
        if self.shadow > 0 and len(readings):
            aside = np.abs(wrap_angle(bearing[:, None] - readings[:, 0]))
            in_front = readings[:, 1] < distance[:, None]
            expected &= ~((aside <= self.shadow) & in_front).any(axis=1)
        if (visible := self.visible) is not None and expected.any():
            expected[expected] = _checked_answer(visible, pose, landmarks[expected])
        return np.asarray(expected)


Visibility = Callable[[Array, Array], BoolArray]


def _checked_answer(visible: Visibility, pose: Array, landmarks: Array) -> BoolArray:
    answer = np.asarray(visible(pose.copy(), landmarks))
    if answer.shape != (len(landmarks),) or answer.dtype != np.bool_:
        raise ValueError(
            f"visible must return {len(landmarks)} booleans, one per landmark, "
            f"got {answer.dtype} of shape {answer.shape}"
        )
    return answer


def _made(kind: type[Any], name: str, given: Mapping[str, Any]) -> Any:
    known = [field.name for field in fields(kind)]
    for key in given:
        if key not in known:
            raise ValueError(f"{name} has no '{key}'{closest(str(key), known)}")
    try:
        return kind(**given)
    except TypeError as error:
        raise ValueError(f"{name} is not complete: {error}") from error
