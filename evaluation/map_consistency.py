"""Tests whether the covariances of final maps agree with their errors: `map_test`.

:class:`MapEvidence` does the same after every run of a study that grows.

A landmark is judged by its position relative to the robot, which a rotation or
translation of the world does not change. Linearisation raises the NEES even of a good
filter by some percent, which many landmarks and runs would show with certainty.
The tests therefore ask not whether a ratio is exactly 1, but whether it lies outside
the margin of :data:`.hypothesis_tests.EQUIVALENCE_MARGIN`, [.8, 1.25].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtr, chdtrc, chndtr

from ..argument_checks import shaped
from ..arrays import Array, BoolArray, IntArray
from .hypothesis_tests import EQUIVALENCE_MARGIN, EquivalenceTest, equivalence_test
from .sequential_tests import EProcess, MeanEProcess, average_of

#: Length of a mean error that counts as zero, in deviations.
BIAS_MARGIN = 0.25
#: Rate at which all its tests together may reject a consistent map.
ERROR_RATE = 0.005
_POINT = 2  # degrees of freedom of a landmark
_LARGEST = 1e100  # larger NEES count as this value
#: Tests that share it: of the whole map, of each landmark, seen from the robot and in
#: the frame of the map, and of the mean error of each.
TESTS = 4


class MapReport(NamedTuple):
    """Result of :func:`map_test`; a ratio is NEES by its degrees of freedom."""

    #: Runs with a NEES of the map.
    runs: int
    #: Runs with a map whose NEES is not finite, as of a singular covariance.
    undefined: int
    #: Runs whose NEES is infinite: their matrix has a negative eigenvalue.
    indefinite: int
    #: Number of runs with a map.
    all_runs: int
    #: Whether the ratio is that of the whole map, with all covariances between
    #: landmarks; else it is the average over the landmarks.
    joint: bool
    #: Mean ratio, shown to lie inside the margin or not.
    equivalence: EquivalenceTest
    #: p-value of the whole map, 1 where it has no NEES.
    joint_p_value: float
    #: Landmarks that at least half of these runs have, shape (k,).
    landmarks: IntArray
    #: Ratio of each of them, shape (k,).
    ratios: Array
    #: Their p-values, adjusted for their number, shape (k,).
    p_values: Array
    #: Ratios of the same in the frame of the map, nan where unknown, shape (k,).
    map_ratios: Array
    #: Their p-values, adjusted for their number, shape (k,).
    map_p_values: Array
    #: Mean error of each in deviations, shape (k, 2).
    means: Array
    #: p-values of the mean errors, adjusted for their number, shape (k,).
    mean_p_values: Array

    @property
    def p_value(self) -> float:
        """Smallest p-value of all tests, adjusted for their number."""
        if self.indefinite:
            return 0.0
        each = (self.joint_p_value, *self.p_values, *self.map_p_values)
        return float(min(1.0, TESTS * min(*each, *self.mean_p_values)))

    @property
    def landmark_p_values(self) -> Array:
        """Smallest p-value of each landmark, shape (k,)."""
        each = np.stack([self.p_values, self.map_p_values, self.mean_p_values])
        return np.asarray(each.min(axis=0))

    @property
    def accepted(self) -> bool:
        """Whether no test rejects; at most .5 % of consistent maps are rejected."""
        return not self.p_value < ERROR_RATE

    @property
    def shown(self) -> bool:
        """Whether no test rejects, and the ratio is shown to be near 1."""
        return self.accepted and not self.undefined and self.equivalence.accepted

    def sentence(self) -> str:
        """Return what the tests find."""
        low, high = self.equivalence.interval
        what = "whole map" if self.joint else "average over the landmarks"
        text = (
            f"Map at the end, {what}: ratio {self.equivalence.statistic:.3f}, 90 % "
            f"interval [{low:.3f}, {high:.3f}]"
        )
        if len(self.landmarks):
            biased = int((self.means**2).sum(axis=1).argmax())
            size = np.hypot(*self.means[biased])
            text += (
                f"{self._worst(self.ratios, 'seen from the robot')}"
                f"{self._worst(self.map_ratios, 'in the frame of the map')}; "
                f"the largest mean error is {size:.2f} deviations "
                f"(landmark {self.landmarks[biased]})"
            )
        if self.undefined or self.indefinite:
            missing = self.undefined + self.indefinite
            text += f"; {missing} of {self.all_runs} maps have no NEES"
        outcome = "accepted" if self.accepted else "rejected"
        return (
            f"{text}: {outcome}, p = {self.p_value:.2g} (rejects a consistent map in "
            f"at most {ERROR_RATE:.1%})."
        )

    def _worst(self, ratios: Array, where: str) -> str:
        """Name the landmark whose ratio is farthest from 1, if any is known."""
        if np.isnan(ratios).all():
            return ""
        k = farthest(np.where(np.isnan(ratios), 1.0, ratios))
        return f"; landmark {self.landmarks[k]} {where} has {ratios[k]:.3g}"


def map_test(
    deviations: ArrayLike,
    nees: ArrayLike | None = None,
    degrees_of_freedom: ArrayLike | None = None,
    landmark_nees: ArrayLike | None = None,
) -> MapReport | None:
    """Test the final maps of independent runs.

    Parameters
    ----------
    deviations : array_like, shape (runs, landmarks, 2)
        Whitened error of each landmark as the robot sees it, of the first kind in
        :class:`.nees.RelativeState`; nan where a run does not have it, infinite where
        its covariance is singular.
    nees, degrees_of_freedom : array_like, shape (runs,), optional
        NEES of the whole map of each run, see :func:`.nees.relative_map_nees`. Without
        it, errors in the covariances between landmarks are not found.
    landmark_nees : array_like, shape (runs, landmarks), optional
        NEES of each landmark in the frame of the map, see :func:`.nees.landmark_nees`;
        nan where a run does not have it.

    Returns
    -------
    MapReport or None
        None if fewer than 2 runs have a map.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> errors = rng.standard_normal((100, 5, 2))
    >>> map_test(errors).shown
    True
    >>> errors[:, 3] *= 2
    >>> map_test(errors).accepted
    False
    """
    errors = np.asarray(deviations, dtype=float)
    if errors.ndim != 3 or errors.shape[2] != _POINT:
        raise ValueError(
            f"deviations must have shape (runs, landmarks, 2), got {errors.shape}"
        )
    squares = (errors**2).sum(axis=2)
    known = ~np.isnan(squares)
    each = np.where(known, squares, 0.0)
    has_map, joint = known.any(axis=1), False
    totals, freedom = each.sum(axis=1), _POINT * known.sum(axis=1)
    if nees is not None and degrees_of_freedom is not None:
        whole = shaped("nees", nees, has_map.shape)
        sizes = shaped("degrees_of_freedom", degrees_of_freedom, has_map.shape)
        joint = bool((sizes > 0).any())
        if joint:
            totals, freedom, has_map = whole, sizes.astype(np.int64), sizes > 0
    indefinite = has_map & np.isposinf(totals) & joint
    defined = has_map & np.isfinite(totals) & np.isfinite(each).all(axis=1)
    if (defined | indefinite).sum() < 2:
        return None
    if defined.sum() < 2:  # none has a NEES: what is known of the landmarks remains
        defined, joint = indefinite & np.isfinite(each).all(axis=1), False
        totals, freedom = each.sum(axis=1), _POINT * known.sum(axis=1)
    each, known, errors = each[defined], known[defined], errors[defined]
    counts = known.sum(axis=0)
    common = np.flatnonzero(counts >= max(2, len(known) / 2))
    counts = counts[common]
    sums = each.sum(axis=0)[common]
    means = np.where(known[..., None], errors, 0.0).sum(axis=0)[common]
    means /= counts[:, None]
    alone = np.full(len(common), np.nan)
    if landmark_nees is not None:
        in_map = np.reshape(landmark_nees, squares.shape)[defined]
        alone = np.where(known, in_map, 0.0).sum(axis=0)[common]
    return MapReport(
        runs=int(defined.sum()),
        undefined=int((has_map & ~defined & ~indefinite).sum()),
        indefinite=int(indefinite.sum()),
        all_runs=int(has_map.sum()),
        joint=joint,
        equivalence=equivalence_test(totals[defined] / freedom[defined], 1),
        joint_p_value=float(
            _outside_margin(totals[defined].sum(), freedom[defined].sum())
        )
        if joint
        else 1.0,
        landmarks=common,
        ratios=sums / (_POINT * counts),
        p_values=_adjusted(_outside_margin(sums, _POINT * counts)),
        map_ratios=alone / (_POINT * counts),
        map_p_values=_adjusted(_outside_margin(alone, _POINT * counts)),
        means=means,
        mean_p_values=_adjusted(
            1 - chndtr(counts * (means**2).sum(axis=1), _POINT, counts * BIAS_MARGIN**2)
        ),
    )


class MapEvidence:
    """Evidence against the final maps, after each of many runs.

    It is the average of four e-processes on the quantities that :func:`map_test` tests:
    the whole map, each landmark seen from the robot and in the frame of the map, and
    the mean error of each. A covariance with a negative eigenvalue is certain evidence.
    """

    def __init__(self) -> None:
        self._whole, self._from_robot, self._in_map = (
            EProcess(EQUIVALENCE_MARGIN) for _ in range(TESTS - 1)
        )
        self._means = MeanEProcess(BIAS_MARGIN, EQUIVALENCE_MARGIN.high)
        self._is_indefinite = False
        #: Number of maps so far without a NEES, for instance by a singular covariance.
        self.undefined = 0

    def update(
        self,
        deviations: Array,
        nees: Array,
        degrees_of_freedom: IntArray,
        landmark_nees: Array,
    ) -> tuple[Array, Array]:
        """Add runs, and return log e after each of them, and their ratios.

        Parameters
        ----------
        deviations, nees, degrees_of_freedom, landmark_nees
            As in :func:`map_test`. Runs with 0 degrees of freedom have no map.

        Returns
        -------
        ndarray, shape (runs,)
        ndarray, shape (runs,)
            NEES of the whole map per degree of freedom; nan where it is undefined.
        """
        squares = (deviations**2).sum(axis=2)
        has_map = degrees_of_freedom > 0
        finite = ~np.isinf(squares).any(axis=1)
        defined = has_map & np.isfinite(nees) & finite
        indefinite = has_map & np.isposinf(nees)
        self.undefined += int((has_map & ~defined & ~indefinite).sum())
        known = np.isfinite(squares) & defined[:, None]
        known_in_map = np.isfinite(landmark_nees) & defined[:, None]
        totals, freedom = np.where(defined, nees, 0.0), degrees_of_freedom * defined
        each = (
            self._whole.update(_kept(totals, defined)[:, None], freedom),
            self._from_robot.update(_kept(squares, known), _POINT * known),
            self._in_map.update(
                _kept(landmark_nees, known_in_map), _POINT * known_in_map
            ),
            self._means.update(np.where(known[:, :, None], deviations, np.nan)),
        )
        certain = np.logical_or.accumulate(indefinite) | self._is_indefinite
        self._is_indefinite |= bool(indefinite.any())
        ratios = totals / np.where(defined, freedom, 1)
        return (
            np.where(certain, np.inf, average_of(each)),
            np.where(defined, ratios, np.nan),
        )


def _kept(nees: Array, known: BoolArray) -> Array:
    """Return known NEES, limited so that no sum overflows, and 0 for others."""
    return np.where(known, np.minimum(nees, _LARGEST), 0.0)


def farthest(ratios: Array) -> int:
    """Return the index of the ratio that is farthest from 1, as a factor."""
    return int(abs(np.log(np.maximum(ratios, np.finfo(float).tiny))).argmax())


def _outside_margin(total: Array, freedom: Array) -> Array:
    """Return p-values of sums of NEES that are χ² times a ratio inside the margin."""
    low, high = EQUIVALENCE_MARGIN
    tails = np.minimum(chdtr(freedom, total / low), chdtrc(freedom, total / high))
    return np.where(np.isnan(tails), 1.0, np.minimum(1.0, 2 * tails))


def _adjusted(p_values: Array) -> Array:
    """Return p-values for the smallest of several (Bonferroni)."""
    return np.asarray(np.clip(p_values * len(p_values), 0.0, 1.0))
