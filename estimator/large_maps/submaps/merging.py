"""Merging of landmarks within a submap: a measurement of zero distance.

A closed submap is never rewritten.  Landmarks are merged whenever the submap is read,
so that the result depends only on the submap and on the list of merged landmarks.
"""

from collections.abc import Mapping

import numpy as np

from ....arrays import Array
from ...filters.gaussian_map import coincide, without_landmarks
from ...models.rigid_motion import ErrorFrame
from .factor import retract
from .store import Submap


def merged(submap: Submap, renamed: Mapping[int, int], frame: ErrorFrame) -> Submap:
    """Return a submap with merged landmarks in one slot.

    If the submap holds both landmarks, it is conditioned on l_i = l_j.  This is linear
    in the coordinates of its error, with H = [… I … −I …] in either frame::

        0 = l_i − l_j = R(t) (l̂_i − l̂_j) + V(t) (ξ_i − ξ_j)

    where t is the error of the heading, about which the measurement has no information.

    Parameters
    ----------
    submap : Submap
        As stored.
    renamed : mapping
        Slots of merged landmarks, and the slots that replace them.
    frame : {"additive", "invariant"}
        Coordinates of the submap's error.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the covariance of the distance of two landmarks is singular.

    Examples
    --------
    >>> P = np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    >>> twice = Submap(np.array([3, 8]), np.array([0, 0, 0, 4.0, 0, 6.0, 0]), P)
    >>> once = merged(twice, {8: 3}, "additive")
    >>> once.slots, once.mean[3:], once.covariance.diagonal()[3:]
    (array([3]), array([5., 0.]), array([0.5, 0.5]))
    """
    before = submap.slots.tolist()
    slots = [renamed.get(slot, slot) for slot in before]
    if slots == before:
        return submap
    mean, covariance = submap.mean, submap.covariance
    first: dict[int, int] = {}
    gone: list[int] = []
    for place, slot in enumerate(slots):
        kept = first.setdefault(slot, place)
        if kept != place:
            mean, covariance = _coincided(mean, covariance, kept, place, frame)
            gone.append(place)
    return Submap(
        np.array(list(first), dtype=np.int64),
        without_landmarks(mean, gone),
        without_landmarks(covariance, gone),
    )


def _coincided(
    mean: Array, covariance: Array, kept: int, gone: int, frame: ErrorFrame
) -> tuple[Array, Array]:
    corrected = coincide(mean, covariance, kept, gone)
    return retract(mean, corrected.mean - mean, frame), corrected.covariance
