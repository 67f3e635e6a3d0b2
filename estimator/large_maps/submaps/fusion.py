"""Fusion of the active submap with the joined map of the closed ones.

A landmark in both has one position, which is an exact measurement of zero difference.
With the frame F = (p, θ) of the active submap and a landmark l in the world, and c the
same landmark in the submap::

    0 = R(θ)ᵀ (l − p) − c

In the coordinates ξ of :mod:`.rigid_motion` its derivative is R(θ)ᵀ (ξ_l − ξ_p) − δc.
It does not depend on the heading, so the measurement gains no information about the
orientation of the whole map.
"""

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from ....arrays import Array, IntArray
from ...interface import Belief
from ...models.rigid_motion import (
    ErrorFrame,
    as_covariance,
    compose,
    invariant_covariance,
)
from ..sparse_cholesky.coordinates import pairs
from .factor import retract
from .gaussian import Gaussian, points_of, state_of, times


def fuse(
    world: Gaussian,
    local: Gaussian,
    frame: ErrorFrame,
    common: tuple[IntArray, IntArray],
) -> Gaussian:
    """Fuse the active submap with the map.

    Parameters
    ----------
    world : Gaussian
        The submap's frame and the map's landmarks, in the world.
    local : Gaussian
        The robot's pose and landmarks in the submap.  Its covariance belongs to the
        error in ``frame``, that of ``world`` to the additive error.
    frame : {"additive", "invariant"}
        Coordinates of the local error.
    common : tuple of two ndarrays
        Positions of the common landmarks in both.

    Returns
    -------
    Gaussian
        The robot's pose in the world, the map's landmarks, then the landmarks that only
        the submap holds.
    """
    mean, own = world.mean, local.mean
    prior = block_diag(invariant_covariance(mean, world.covariance), local.covariance)
    if len(common[0]):
        A, innovation = _difference(mean, own, frame, common)
        AP = A @ prior
        S = AP @ A.T
        lower = _root((S + S.T) / 2)
        V = solve_triangular(
            lower, np.column_stack([AP, innovation]), lower=True, check_finite=False
        )
        step = V[:, :-1].T @ V[:, -1]
        prior -= V[:, :-1].T @ V[:, :-1]
        mean = retract(mean, step[: len(mean)], "invariant")
        own = retract(own, step[len(mean) :], frame)
    return _composed(mean, own, prior, frame, common[1])


def _root(S: Array) -> Array:
    try:
        return np.linalg.cholesky(S).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "the active submap cannot be joined to the map, because the covariance of "
            "their differences is not positive definite: measurement_std is degenerate"
        ) from None


def _difference(
    mean: Array, own: Array, frame: ErrorFrame, common: tuple[IntArray, IntArray]
) -> tuple[Array, Array]:
    """Return the Jacobian by (ξ, local error), and the innovation."""
    count = len(common[0])
    out = np.exp(-1j * mean[2])
    inside = 3 + pairs(common[0])
    beside = len(mean) + 3 + pairs(common[1])
    A = np.zeros((2 * count, len(mean) + len(own)))
    A[:, :2] = -np.tile(np.eye(2), (count, 1))
    A[np.arange(2 * count), inside] = 1.0
    A = times(out, A)
    A[np.arange(2 * count), beside] = -1.0
    c = points_of(own)[1 + common[1]]
    if frame == "invariant":
        A[:, len(mean) + 2] = -(1j * c).view(np.float64)
    points = points_of(mean)
    difference = out * (points[1 + common[0]] - points[0]) - c
    return A, -difference.view(np.float64)


def _composed(
    mean: Array, own: Array, covariance: Array, frame: ErrorFrame, known: IntArray
) -> Gaussian:
    """Return robot, map and new landmarks in the world, with additive error."""
    fresh = np.setdiff1d(np.arange((len(own) - 3) // 2), known)
    pose, by_start, by_pose = compose(mean[:3], own[:3])
    seen = np.exp(1j * mean[2]) * points_of(own)[1 + fresh]
    landmarks = points_of(mean)[1:]
    points = np.concatenate(
        [[complex(*pose[:2])], landmarks, complex(*mean[:2]) + seen]
    )
    cut = len(mean)
    T = np.zeros((cut + 2 * len(fresh), len(covariance)))
    T[:3, :3], T[:3, cut : cut + 3] = by_start, by_pose
    T[np.arange(3, cut), np.arange(3, cut)] = 1.0
    T[cut:, :2] = np.tile(np.eye(2), (len(fresh), 1))
    T[cut:, 2] = (1j * seen).view(np.float64)
    new = np.zeros((2 * len(fresh), len(own)))
    new[np.arange(2 * len(fresh)), 3 + pairs(fresh)] = 1.0
    T[cut:, cut:] = times(np.exp(1j * mean[2]), new)
    # From ξ to the additive error: e = ξ + (J q; 0 at θ) ξ_θ.
    T[:, 2] += T[:, :cut] @ state_of(1j * points_of(mean), 0.0)
    if frame == "invariant":
        T[:, cut + 2] += T[:, cut:] @ state_of(1j * points_of(own), 0.0)
    moved = as_covariance(T @ covariance @ T.T)
    return Gaussian(state_of(points, float(pose[2])), moved)


def part_of(
    map_: Gaussian, order: IntArray, wanted: IntArray, ids: tuple[int, ...]
) -> Belief:
    """Return the marginal of the pose and some landmarks.

    Parameters
    ----------
    map_ : Gaussian
        Of n landmarks.
    order : ndarray, shape (n,)
        Slots of these landmarks.
    wanted : ndarray, shape (v,)
        Slots of the wanted landmarks.
    ids : tuple of int
        Identities of the wanted landmarks.
    """
    sorter = np.argsort(order)
    places = sorter[np.searchsorted(order, wanted, sorter=sorter)]
    rows = np.concatenate([np.arange(3), 3 + pairs(places)])
    covariance = map_.covariance[rows[:, None], rows]
    return Belief(map_.mean[rows], covariance, ids, "invariant")
