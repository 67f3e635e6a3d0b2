"""How well readings without identity were associated, by their true landmarks.

`score_association` counts the decisions of a run, `gospa` scores its map, and
`oracle_errors` returns what even the true pose and map would assign wrongly.

The identity of a mapped landmark is the true landmark of the reading that confirmed it,
the one with which it entered the map.  Every reading counts once, by the decision that
stands at the end of the run::

                     the reading is of …
    given to …       a true landmark            clutter
    a mapped one     correct or wrong           clutter_used
    a new one        new_correct or duplicate   ghost
    none             missed, if mapped          -

Readings before the confirming one count where the filter applied them in the end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..argument_checks import as_floats
from ..arrays import SMALLEST, AnyArray, Array
from ..estimator.interface import ScanDecisions
from ..estimator.models.rigid_motion import rotation
from ..estimator.models.sensors import Sensor, find_sensor

CLUTTER = -1  # the true landmark of a reading that has none


class AssociationScores(NamedTuple):
    """Counts of readings, and sizes of maps."""

    #: Readings given to the mapped landmark that they are of.
    correct: int
    #: Readings of a true landmark given to a mapped landmark of another place.
    wrong: int
    #: New landmarks of a place that was not in the map.
    new_correct: int
    #: New landmarks of a place that was in the map already.
    duplicate: int
    #: New landmarks confirmed by clutter.
    ghost: int
    #: Readings of a place in the map that were given to no landmark.
    missed: int
    #: Clutter given to a mapped landmark.
    clutter_used: int
    #: Landmarks in the map at the end.
    map_size: int
    #: Places seen often enough to be known, by the rule of confirmation.
    true_map_size: int

    @property
    def precision(self) -> float:
        """Share of right decisions among readings given to landmarks, or nan."""
        right = self.correct + self.new_correct
        errors = self.wrong + self.duplicate + self.ghost + self.clutter_used
        return _share(right, right + errors)

    @property
    def recall(self) -> float:
        """Share of right decisions among readings of landmarks, or nan.

        Readings of a place that is not mapped yet and that are given to no landmark
        count neither way.
        """
        right = self.correct + self.new_correct
        return _share(right, right + self.wrong + self.duplicate + self.missed)

    def as_dict(self) -> dict[str, float]:
        """Return all by name, with precision and recall."""
        shares = {"precision": self.precision, "recall": self.recall}
        return {**self._asdict(), **shares}


def score_association(
    decisions: Sequence[ScanDecisions],
    true_ids: Sequence[ArrayLike],
    *,
    places: Mapping[int, int] | None = None,
    confirm: tuple[int, int] = (1, 1),
) -> AssociationScores:
    """Compare the decisions about all readings of a run with the truth.

    Parameters
    ----------
    decisions : sequence of ScanDecisions
        One per scan.
    true_ids : sequence of array_like of int, shape (m,)
        Per scan the true landmark of each reading, -1 for clutter.
    places : mapping of int to int, optional
        Place of each true landmark, see :func:`places_of`; landmarks of one place count
        as one.  By default, each is a place of its own.
    confirm : (int, int)
        (k, n): a place is known once it was seen in k of n successive scans.

    Returns
    -------
    AssociationScores

    Raises
    ------
    ValueError
        If decisions and true ids do not match.

    Examples
    --------
    >>> scans = [ScanDecisions((0,), added=(0,)), ScanDecisions((0, None))]
    >>> score_association(scans, [[7], [7, -1]]).as_dict()["correct"]
    1
    """
    scans = _checked(decisions, true_ids)
    seen = [[_place(places, i) for i in row.tolist()] for row in scans]
    owners = _owners(zip(decisions, seen, strict=True))
    counts = Counter(dict.fromkeys(AssociationScores._fields, 0))
    in_map: dict[int, int] = {}
    for made, scan in zip(decisions, seen, strict=True):
        counts.update(_outcomes(made, scan, in_map, owners))
        for gone in (*made.removed, *(gone for _, gone in made.merged)):
            in_map.pop(gone, None)
    counts["map_size"] = len(in_map)
    counts["true_map_size"] = len(known_places(seen, confirm))
    return AssociationScores(**counts)


def oracle_errors(
    poses: Array,
    scans: Sequence[Array],
    true_ids: Sequence[ArrayLike],
    landmark_ids: ArrayLike,
    landmarks: ArrayLike,
    measurement_std: Sequence[float],
    *,
    sensor: str | Sensor = "bearing_range",
    places: Mapping[int, int] | None = None,
) -> float:
    """Return the share of readings that the true pose and map would assign wrongly.

    Each reading of a landmark goes to the landmark at the least Mahalanobis distance
    νᵀ Q⁻¹ ν, with the noise Q of the sensor.  The share is a bar for 1 − precision.

    Parameters
    ----------
    poses : ndarray, shape (K, 3)
        True pose of each scan; readings at an unknown one, nan, do not count.
    scans : sequence of ndarray, shape (m, 2)
        Rows (β, r) [rad, m], or those of the sensor.
    true_ids, places
        As in :func:`score_association`.
    landmark_ids, landmarks : array_like, shapes (n,) and (n, 2)
        The true landmarks.
    measurement_std : (float, float)
        (σβ, σr) [rad, m].
    sensor : str or Sensor
        What a reading is, with its noise.

    Returns
    -------
    float
        nan if no reading is of a landmark.

    Examples
    --------
    >>> readings = np.array([(0.0, 5.0), (0.3, 5.0)])
    >>> world = [4, 8], [(5.0, 0.0), (5.0, 1.0)]
    >>> oracle_errors(np.zeros((1, 3)), [readings], [[4, 4]], *world, (0.1, 0.1))
    0.5
    """
    read = find_sensor(sensor)
    names, true = np.asarray(landmark_ids, np.int64), as_floats("landmarks", landmarks)
    groups = np.array([_place(places, i) for i in names.tolist()])
    wrong = count = 0
    for pose, readings, ids in zip(poses, scans, true_ids, strict=True):
        of = np.asarray(ids, dtype=np.int64)
        z, of = readings[np.isin(of, names)], of[np.isin(of, names)]
        if not len(z) or not np.isfinite(pose).all():
            continue
        x, y = ((true - pose[:2]) @ rotation(pose[2])).T
        distance = np.maximum(np.hypot(x, y), SMALLEST)
        stds = np.maximum(read.stds(measurement_std, distance), SMALLEST)
        with np.errstate(divide="ignore", invalid="ignore"):  # slopes at the landmark
            apart = read.difference(z[:, None], read.read(x, y))
        squared = ((apart / stds) ** 2).sum(axis=2)
        right = [_place(places, i) for i in of.tolist()]
        wrong += int((groups[squared.argmin(axis=1)] != right).sum())
        count += len(right)
    return _share(wrong, count)


def landmark_identities(
    decisions: Sequence[ScanDecisions], true_ids: Sequence[ArrayLike]
) -> dict[int, int]:
    """Return the true landmark, -1 for clutter, of all landmarks that were ever mapped.

    Parameters
    ----------
    decisions, true_ids
        As in :func:`score_association`.
    """
    scans = _checked(decisions, true_ids)
    return _owners(zip(decisions, (row.tolist() for row in scans), strict=True))


def places_of(
    landmark_ids: ArrayLike, landmarks: ArrayLike, resolution: float
) -> dict[int, int]:
    """Group true landmarks that are nearer to each other than a resolution.

    Parameters
    ----------
    landmark_ids : array_like of int, shape (n,)
        Their identities.
    landmarks : array_like, shape (n, 2)
        Their positions [m].
    resolution : float
        R [m]: landmarks connected by gaps below it are one place.

    Returns
    -------
    dict of int to int
        For each landmark the least identity in its place.

    Raises
    ------
    ValueError
        If the resolution is negative, or the arrays do not match.

    Examples
    --------
    >>> places_of([3, 5, 8], [(0, 0), (0.4, 0), (2, 0)], resolution=0.5)
    {3: 3, 5: 3, 8: 8}
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 (slow to import)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415
    from scipy.spatial import cKDTree  # noqa: PLC0415

    ids = np.asarray(landmark_ids, dtype=np.int64)
    positions = as_floats("landmarks", landmarks).reshape(-1, 2)
    if ids.shape != (len(positions),):
        raise ValueError(
            "landmark_ids must have one entry per landmark, got shape "
            f"{ids.shape} for {len(positions)}"
        )
    if not 0 <= resolution < np.inf:
        raise ValueError(f"resolution must be a number >= 0, got {resolution!r}")
    gap = np.nextafter(resolution, 0.0)  # query_pairs includes its distance
    pairs = cKDTree(positions).query_pairs(gap, output_type="ndarray")
    if resolution == 0:
        pairs = pairs[:0]
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(ids), len(ids)))
    _, group = connected_components(graph)
    least = {g: int(ids[group == g].min()) for g in set(group.tolist())}
    return {int(i): least[g] for i, g in zip(ids, group.tolist(), strict=True)}


def known_places(seen: Sequence[Sequence[int]], confirm: tuple[int, int]) -> set[int]:
    """Return the places seen in k of n successive scans.

    Parameters
    ----------
    seen : sequence of sequence of int
        The places that each scan shows, -1 for clutter.
    confirm : (int, int)
        (k, n).

    Examples
    --------
    >>> sorted(known_places([[1, 2], [-1], [2], [], [1, 2]], confirm=(2, 3)))
    [2]
    """
    needed, window = confirm
    sightings: dict[int, list[int]] = {}
    for number, scan in enumerate(seen):
        for place in set(scan) - {CLUTTER}:
            sightings.setdefault(place, []).append(number)
    lag = needed - 1
    return {
        place
        for place, scans in sightings.items()
        if any(b - a < window for a, b in zip(scans, scans[lag:], strict=False))
    }


def _outcomes(
    made: ScanDecisions,
    scan: Sequence[int],
    in_map: dict[int, int],
    owners: Mapping[int, int],
) -> Iterator[str]:
    """Yield which counts the decisions about a scan add to; put new ones in the map."""
    new = set(made.added)
    for landmark, place in zip(made.row_ids, scan, strict=True):
        if landmark is None:
            if place != CLUTTER and place in in_map.values():
                yield "missed"
        elif landmark in new:
            yield _kind_of_new(place, in_map)
            new.remove(landmark)
            in_map[landmark] = place
        elif place == CLUTTER:
            yield "clutter_used"
        else:
            yield "correct" if owners.get(landmark) == place else "wrong"


def _kind_of_new(place: int, in_map: Mapping[int, int]) -> str:
    if place == CLUTTER:
        return "ghost"
    return "duplicate" if place in in_map.values() else "new_correct"


def _owners(scans: Iterator[tuple[ScanDecisions, list[int]]]) -> dict[int, int]:
    """Return whose reading confirmed each landmark."""
    owners: dict[int, int] = {}
    for made, truth in scans:
        for landmark in made.added:
            owners.setdefault(landmark, truth[made.row_ids.index(landmark)])
    return owners


def _checked(
    decisions: Sequence[ScanDecisions], true_ids: Sequence[ArrayLike]
) -> list[np.ndarray[tuple[int, ...], np.dtype[np.int64]]]:
    if len(decisions) != len(true_ids):
        raise ValueError(
            f"true_ids must be of {len(decisions)} scans, got {len(true_ids)}"
        )
    scans = [np.asarray(row, dtype=np.int64) for row in true_ids]
    for number, (made, row) in enumerate(zip(decisions, scans, strict=True)):
        if row.shape != (len(made.row_ids),):
            raise ValueError(
                f"true_ids[{number}] must have one entry per reading, got shape "
                f"{row.shape} for {len(made.row_ids)}"
            )
    return scans


def _place(places: Mapping[int, int] | None, landmark: int) -> int:
    if places is None or landmark == CLUTTER:
        return landmark
    return places.get(landmark, landmark)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


# --------------------------------------------------------------------------------------
# The error of a map with a penalty for missed and for false landmarks.
#
# GOSPA is the generalised optimal sub-pattern assignment metric [1]_.  For p = α = 2::
#
#     GOSPA² = min over assignments γ of  Σ_γ ‖x − y‖²  +  c²/2 (missed + false)
#
# over pairs (x, y) of an estimated and a true landmark nearer than the cut-off c.  The
# other true landmarks are missed, the other estimated ones are false.
#
# References
# ----------
# .. [1] A. S. Rahmathullah, Á. F. García-Fernández, L. Svensson, Generalized optimal
#    sub-pattern assignment metric, 20th International Conference on Information Fusion,
#    2017.

CUTOFF = 1.0  # an estimate farther than this from a true landmark is not of it [m]


class Gospa(NamedTuple):
    """The metric and its three parts: distance² = localisation + missed + false."""

    #: The metric [m].
    distance: float
    #: Σ ‖x − y‖² over the pairs [m²].
    localisation: float
    #: c²/2 for each true landmark without an estimate [m²].
    missed: float
    #: c²/2 for each estimate without a true landmark [m²].
    false: float
    #: Number of pairs.
    pairs: int
    #: Number of missed landmarks.
    missed_count: int
    #: Number of false landmarks.
    false_count: int


def gospa(
    estimate: ArrayLike,
    truth: ArrayLike,
    cutoff: float = CUTOFF,
    *,
    places: ArrayLike | None = None,
) -> Gospa:
    """Compare a map with the truth.

    Parameters
    ----------
    estimate : array_like, shape (n, 2)
        Estimated landmarks [m].
    truth : array_like, shape (m, 2)
        True landmarks [m].
    cutoff : float
        c [m].
    places : array_like of int, shape (m,), optional
        Place of each true landmark: those of one place count as one, as far from an
        estimate as the nearest of them.

    Returns
    -------
    Gospa

    Raises
    ------
    ValueError
        If an array is not of positions, the cut-off is not above 0, or there is not one
        place for each true landmark.

    Examples
    --------
    >>> found = gospa([(0.0, 0.6), (9.0, 9.0)], [(0.0, 0.0)])
    >>> found.localisation, found.missed, found.false, round(found.distance, 3)
    (0.36, 0.0, 0.5, 0.927)
    """
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 (slow to import)
    from scipy.spatial.distance import cdist  # noqa: PLC0415

    x, y = (
        as_floats(name, value).reshape(-1, 2)
        for name, value in (("estimate", estimate), ("truth", truth))
    )
    if not 0 < cutoff < np.inf:
        raise ValueError(f"cutoff must be a number > 0, got {cutoff!r}")
    gaps = np.minimum(cdist(x, y), cutoff)
    if places is not None:
        gaps = _nearest_of_each(gaps, np.asarray(places))
    chosen = gaps[linear_sum_assignment(gaps**2)]
    near = chosen[chosen < cutoff]
    pairs = len(near)
    missed, false = gaps.shape[1] - pairs, len(x) - pairs
    penalty = cutoff**2 / 2
    parts = float(np.sum(near**2)), penalty * missed, penalty * false
    return Gospa(float(np.sqrt(sum(parts))), *parts, pairs, missed, false)


def _nearest_of_each(gaps: Array, places: AnyArray) -> Array:
    """Reduce gaps (n, m) to landmarks to gaps (n, k) to their k places."""
    if places.shape != gaps.shape[1:]:
        raise ValueError(
            f"places must have one entry per true landmark, got shape {places.shape} "
            f"for {gaps.shape[1]}"
        )
    each = [gaps[:, places == place].min(axis=1) for place in np.unique(places)]
    return np.array(each).T.reshape(len(gaps), len(each))
