"""Selection of the measurements of one scan, with their NIS."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack, solve_triangular

from ....arrays import Array, BoolArray, IntArray
from ...filters.ekf import EkfSlam, MotionNoise, reading_variances
from ...filters.gaussian_map import not_positive_definite
from ...support import argument_checks
from .conditional_pose import ConditionalPose, LinearScan, marginalise_pose
from .linearisation import BASES, linearise_scan
from .local_information import LocalInformation


class Screened(NamedTuple):
    """n measurements of mapped landmarks; m are used."""

    skipped: BoolArray
    """Landmark expected below the minimum range, shape (n,)."""
    gated: BoolArray
    """Rejected by the gate, shape (n,)."""
    near: BoolArray
    """Robot within 10 σ of the landmark, shape (n,)."""
    scan: LinearScan
    """The m used measurements, linearised at the prior."""
    nis: float
    factor: Array
    """L, shape (2m, 2m), L Lᵀ = S."""


class ScanRules:
    """Noise and acceptance rules of measurements, checked by :class:`EkfSlam`."""

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        base: str,
        **settings: Any,
    ) -> None:
        self.base = argument_checks.one_of("base", base, BASES)
        unknown = set(settings) - {
            "range_std_per_metre",
            "range_noise_at",
            "bearing_std_metres",
            "gate_probability",
            "noise_at_rest",
            "min_range",
        }
        if unknown:
            raise TypeError(f"SparseInformationSlam has no option {min(unknown)!r}")
        self.rules = EkfSlam(motion_std, measurement_std, **settings).rules
        at_rest = settings.get("noise_at_rest", True)
        self.motion_noise = MotionNoise.checked(motion_std, at_rest)
        bearing_std = self.rules.bearing_std + self.rules.bearing_std_metres
        if min(bearing_std, self.rules.range_std) <= 0:
            raise ValueError(
                "measurement_std must be 2 finite numbers > 0, because an exact "
                f"measurement has infinite information, got {measurement_std!r}"
            )

    def screen(
        self,
        pose: ConditionalPose,
        local: LocalInformation,
        places: IntArray,
        readings: Array,
        ids: list[int],
    ) -> Screened:
        """Linearise measurements of local landmarks and select those to use.

        S = H Σ Hᵀ + N, with Σ = (Λ_LL − C)⁻¹ and H, N from :func:`marginalise_pose`.
        """
        expected = np.hypot(*(local.points.reshape(-1, 2)[places] - pose.mean[:2]).T)
        skipped = expected < self.rules.min_range
        kept = ~skipped
        places, readings = places[kept], readings[kept]
        at = readings[:, 1] if self.rules.noise_as_read else expected[kept]
        variance = reading_variances(self.rules, at)
        scan = linearise_scan(self.base, local, pose, places, readings, variance)
        S = _innovation_covariance(pose, local, scan)
        blocks = np.array(
            [S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(places))]
        ).reshape(-1, 2, 2)
        refused = _squared_distances(scan.innovation, blocks) > self.rules.gate
        gated, near = np.zeros_like(skipped), np.zeros_like(skipped)
        gated[kept], near[kept] = refused, _is_too_near(scan, blocks, expected[kept])
        used = np.repeat(~refused, 2)
        used_ids = [i for i, k in zip(ids, kept & ~gated, strict=True) if k]
        factor, nis = np.empty((0, 0)), 0.0
        scan = scan.subset(~refused)
        if used_ids:
            factor = _factor(S[np.ix_(used, used)], used_ids)
            white = solve_triangular(factor, scan.innovation.ravel(), lower=True)
            nis = float(white @ white)
        return Screened(skipped, gated, near, scan, nis, factor)


def _innovation_covariance(
    pose: ConditionalPose, local: LocalInformation, scan: LinearScan
) -> Array:
    if not len(scan.landmarks):
        return np.empty((0, 0))
    H, N = marginalise_pose(pose, scan)
    spread = solve_triangular(local.solver()[0], H.T, lower=True, check_finite=False)
    return np.asarray(spread.T @ spread + N)


def _squared_distances(innovation: Array, blocks: Array) -> Array:
    """Return the NIS of each measurement alone, shape (n,)."""
    solved = np.linalg.solve(blocks, innovation[..., None])[..., 0]
    return np.asarray((innovation * solved).sum(axis=1))


def _is_too_near(scan: LinearScan, blocks: Array, distance: Array) -> BoolArray:
    """Return whether the robot is within 10 σ of each landmark, as :class:`EkfSlam`.

    A landmark's covariance in the robot frame is H_l⁻¹ (S − Q) H_l⁻ᵀ.
    """
    noise = np.einsum("ni,ij->nij", scan.variance, np.eye(2))
    back = np.linalg.inv(scan.jacobian_landmark)
    place = back @ (blocks - noise) @ back.transpose(0, 2, 1)
    spread = np.linalg.eigvalsh(place)[:, -1] if len(place) else np.empty(0)
    return np.asarray(distance**2 < 100 * spread)


def _factor(S: Array, ids: list[int]) -> Array:
    factor, failed = lapack.dpotrf(S, lower=1, clean=1)
    if failed:
        raise not_positive_definite(ids[(failed - 1) // 2])
    return np.asarray(factor)
