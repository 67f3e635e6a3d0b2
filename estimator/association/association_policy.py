"""The policy by which readings are associated and new landmarks confirmed."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp
from typing import Any

from ..support import argument_checks

ASSOCIATIONS = ("auto", "nearest", "joint", "compatibility", "hypotheses")

MOST_SCANS = 63  # that fit one mask of a tentative landmark


@dataclass(frozen=True)
class AssociationPolicy:
    """How readings are associated, and when a new landmark is confirmed.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    association: str = "auto"
    """How readings without identity are assigned to landmarks: "nearest", each reading
    to its most likely landmark; "joint", the most likely assignment of the whole scan;
    "compatibility", the most pairs that are jointly compatible (JCBB); "hypotheses",
    several joint assignments, followed until the readings decide between them; "auto",
    hypotheses, but joint in filters for large maps and those that observe the truth."""
    density: float | None = None
    """Readings per scan from no landmark of the map, clutter and new landmarks
    [1 / (rad m)]; None: estimate it from the scans so far."""
    hypotheses: int = 10
    """Most hypotheses at a time."""
    branches: int = 4
    """Most assignments of one scan that a hypothesis splits into."""
    search_nodes: int = 2000
    """Limit of the search for joint assignments; beyond it the best found so far is
    taken."""
    pair_gate: float = 15.0
    """A joint assignment pairs a reading and a landmark up to this νᵀ S⁻¹ ν, given the
    other pairs."""
    backdate: bool = True
    """Whether the sightings before the confirming one count: the filter then repeats
    the scans since the first sighting, with the new landmark in them."""
    match_gate: float = 9.21
    """A reading is of a landmark only up to this νᵀ S⁻¹ ν; χ² of 2 dof, here 99 %."""
    new_gate: float = 25.0
    """A reading is of a new landmark only beyond this from all that are known."""
    ambiguity: float = 1.0
    """Left out where two landmarks differ by less than this in −2 ln likelihood."""
    confirm: tuple[int, int] = (3, 8)
    """(k, n): seen in k of n successive scans, a landmark enters the map."""
    trust_ids: bool = True
    """Whether landmarks that come with an identity enter at first sight."""

    def __post_init__(self) -> None:
        argument_checks.one_of("association", self.association, ASSOCIATIONS)
        if self.density is not None:
            argument_checks.above("density", self.density, 0.0)
        for name in ("hypotheses", "branches", "search_nodes"):
            argument_checks.whole(name, getattr(self, name), 1)
        argument_checks.above("pair_gate", self.pair_gate, 0.0)
        argument_checks.flag("backdate", self.backdate)
        argument_checks.above("match_gate", self.match_gate, 0.0)
        argument_checks.at_least("new_gate", self.new_gate, self.match_gate)
        argument_checks.at_least("ambiguity", self.ambiguity, 0.0)
        argument_checks.flag("trust_ids", self.trust_ids)
        object.__setattr__(self, "confirm", _k_of_n(self.confirm))

    @property
    def pair_tail(self) -> float:
        """P(χ²₂ > pair_gate): the level of joint tests of several pairs."""
        return exp(-self.pair_gate / 2)


def _k_of_n(value: Any) -> tuple[int, int]:
    try:
        k, n = value
    except (TypeError, ValueError):
        raise ValueError(
            f"confirm must be two whole numbers (k, n), got {value!r}"
        ) from None
    k, n = (
        argument_checks.whole("confirm[0]", k, 1),
        argument_checks.whole("confirm[1]", n, 1),
    )
    if not k <= n <= MOST_SCANS:
        raise ValueError(
            f"confirm must be (k, n) with k <= n <= {MOST_SCANS}, got ({k}, {n})"
        )
    return k, n
