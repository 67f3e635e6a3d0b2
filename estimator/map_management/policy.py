"""The policy that decides when landmarks enter a map, are merged, and are removed."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import sqrt
from typing import Any, TypeVar

import numpy as np

from ...arrays import Array
from ...suggestions import closest
from ..association.association_policy import AssociationPolicy
from ..association.constellations import Constellations
from ..support import argument_checks
from .field_of_view import FieldOfView


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

    view: FieldOfView | None = None
    """Field of view of the sensor; required by ``remove_after``."""
    remove_after: int | None = None
    """Remove a landmark missed in this many scans since it was last seen."""
    merge_within: float | None = None
    """Smallest distance of two landmarks [m]; landmarks estimated closer are merged."""
    merge_gate: float = 9.21
    """Largest Dᵀ C⁻¹ D, of the offset D, at which two landmarks may be one."""
    constellations: Constellations | None = None
    """How landmarks around the robot are recognised as older ones after long drift;
    None: never."""
    capacity: int | None = None
    """Largest number of landmarks; beyond it the least informative are removed."""

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
                "constellations must be Constellations, its fields as a mapping, True, "
                f"or None, got {self.constellations!r}"
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
        ranges = readings[np.isfinite(readings[:, 1]), 1]
        reach = float(ranges.max(initial=0.0))
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


def as_policy(value: "LandmarkPolicy | Mapping[str, Any] | bool") -> LandmarkPolicy:
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
    if isinstance(given.get("view"), Mapping):
        given["view"] = _made(FieldOfView, "management.view", given["view"])
    if isinstance(rules := given.get("constellations"), Mapping):
        name = "management.constellations"
        given["constellations"] = _made(Constellations, name, rules)
    return _made(LandmarkPolicy, "management", given)


def policy_of(slam: object) -> LandmarkPolicy:
    """Return the policy of an estimator; the default where it has none."""
    policy = getattr(slam, "policy", None)
    return policy if isinstance(policy, LandmarkPolicy) else LandmarkPolicy()


Made = TypeVar("Made", LandmarkPolicy, FieldOfView, Constellations)


def _made(kind: type[Made], name: str, given: Mapping[str, Any]) -> Made:
    known = [field.name for field in fields(kind)]
    for key in given:
        if key not in known:
            raise ValueError(f"{name} has no '{key}'{closest(str(key), known)}")
    try:
        return kind(**given)
    except TypeError as error:
        raise ValueError(f"{name} is not complete: {error}") from error
