"""The policy by which readings are associated and new landmarks confirmed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..support import argument_checks

MOST_SCANS = 63  # that fit one mask of a tentative landmark


@dataclass(frozen=True)
class AssociationPolicy:
    """Which landmark a reading is of, and when a new one is believed.

    Raises
    ------
    ValueError
        Where a value is out of range.
    """

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
        argument_checks.above("match_gate", self.match_gate, 0.0)
        argument_checks.at_least("new_gate", self.new_gate, self.match_gate)
        argument_checks.at_least("ambiguity", self.ambiguity, 0.0)
        argument_checks.flag("trust_ids", self.trust_ids)
        object.__setattr__(self, "confirm", _k_of_n(self.confirm))


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
