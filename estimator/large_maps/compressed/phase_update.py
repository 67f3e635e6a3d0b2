"""Exact deferral: a phase in a local map, and its effect on the rest of the map.

At the beginning of a phase let S (s, width) be the covariance of the s local
coordinates x_a (pose and local landmarks) with all others, x_b.  The phase only
measures x_a.  The ordinary filter then runs on an extended state (x_a, y)::

    mean (x_a, 0),   covariance [P_aa  I; I  0]

x_b is a linear function of y, x_b = Sᵀ y + terms that do not change.  With the final
covariance [P_aa Φ; Φᵀ −Ψ] and mean (x_a, y), the phase changes the rest of the map by::

    x_b ← x_b + Sᵀ y,   P_ab ← Φ S,   P_bb ← P_bb − Sᵀ Ψ S

(Guivant and Nebot, 2001, in the form of an augmented state.)

In the invariant frame a correction also rotates and shears points,
q⁺ = q + V(t) δq, and the covariance is transported, P ← T P Tᵀ, e_q⁺ = e_q + J (q⁺ − q)
e_θ.  Both are linear in q read as a complex number, J = i.  There y is one complex
number for each of the s coordinates, a *virtual landmark* at the origin.  With x_b and
the rows of S read as complex numbers, the equations above hold unchanged.
"""

from typing import NamedTuple

import numpy as np

from ....arrays import Array
from ...filters.ekf import EkfSlam
from .row_exchange import fill_extended, unpivot

# A filter's arrays may be larger than needed by this factor.
_ROOMY = 3


class Phase(NamedTuple):
    """The parts of the filter's belief at the end of a phase."""

    mean: Array  # (a,) of pose and local landmarks
    reference: Array  # (a,) their linearisation points, for filters that fix them
    covariance: Array  # P_aa, (a, a)
    gain: Array  # Φ, (a, e)
    loss: Array  # Ψ, (e, e)
    shift: Array  # y, (1, e)


def virtual_landmarks(coordinates: int, invariant: bool) -> int:
    """Return the number of landmarks whose places the extension takes."""
    return coordinates if invariant else (coordinates + 1) // 2


def begin_phase(
    slam: EkfSlam,
    mean: Array,
    rows: Array,
    reference: Array,
    ids: list[int],
    *,
    in_place: bool,
) -> None:
    """Replace the map of a filter by the extension, followed by a local map.

    Parameters
    ----------
    slam : EkfSlam
        The pose and its covariance are kept.
    mean, reference : ndarray, shape (2n,)
        Of the n local landmarks.
    rows : ndarray, shape (3 + 2n, 2n)
        Covariance of pose and local landmarks with these; the lower half is used.
    ids : list of int
        Identities of the virtual landmarks, if any, then of the local ones.
    in_place : bool
        Whether the old arrays may be overwritten.
    """
    gaussian, size = slam.map, 3 + 2 * len(ids)
    before = gaussian.size
    pose, pose_mean = gaussian.covariance[:3, :3].copy(), gaussian.mean[:3].copy()
    fixed = gaussian.reference[:3].copy()
    if not (in_place and size < gaussian.capacity <= _ROOMY * size):
        gaussian.allocate(len(ids), more=len(ids) // 2)
        before = 0
    virtual = size - len(rows)
    step = 2 if virtual == 2 * len(rows) else 1
    for array, head, tail in (
        (gaussian.mean, pose_mean, mean),
        (gaussian.reference, fixed, reference),
    ):
        array[:before] = 0.0
        array[:3], array[3 + virtual : size] = head, tail
    fill_extended(gaussian.covariance, before, pose, rows, virtual, step)
    gaussian.relabel(ids)


def end_phase(slam: EkfSlam, virtual: int) -> Phase:
    """Split the belief of a filter that ran on an extended state; return copies.

    Without an extension the covariance is a view: the local map may be large.
    """
    size, rest = slam.map.size, 3 + 2 * virtual
    mean, covariance = slam.map.mean[:size], slam.map.covariance[:size, :size]
    if not virtual:
        reference, nothing = slam.map.reference[:size].copy(), np.empty((size, 0))
        none = np.empty((1, 0))
        return Phase(mean.copy(), reference, covariance, nothing, none[:0], none)
    rows = np.concatenate([covariance[:3], covariance[rest:]])
    return Phase(
        _without(mean, rest),
        _without(slam.map.reference[:size], rest),
        np.concatenate([rows[:, :3], rows[:, rest:]], axis=1),
        rows[:, 3:rest].copy(),
        -covariance[3:rest, 3:rest],
        mean[None, 3:rest].copy(),
    )


def _without(vector: Array, rest: int) -> Array:
    return np.concatenate([vector[:3], vector[rest:]])


def combine(coefficients: Array, strip: Array, invariant: bool) -> Array:
    """Return Φ S, shape (k, width), of coefficients (k, e) and the strip (s, width)."""
    if not invariant:
        product: Array = coefficients[:, : len(strip)] @ strip
        return product
    turned = coefficients.view(np.complex128) @ strip.view(np.complex128)
    return turned.view(np.float64)


def roots(loss: Array, invariant: bool) -> tuple[Array, Array]:
    """Factor Ψ = U diag(s) Uᵀ at its numerical rank.

    The rank of Ψ is that of the measurements of the phase, far below its size.  In the
    invariant frame, Ψ is indefinite.

    Returns
    -------
    root : ndarray, shape (rank, e)
        Uᵀ.
    signs : ndarray, shape (rank,)
        s, each 1 or -1.
    """
    if not invariant:
        return _by_pivots(loss)
    used = np.flatnonzero(loss.any(axis=0))
    root, signs = _by_eigenvalues(loss[used[:, None], used])
    rows = np.zeros((len(root), len(loss)))
    rows[:, used] = root
    return rows, signs


def _by_pivots(loss: Array) -> tuple[Array, Array]:
    """Pivoted Cholesky decomposition of a semidefinite matrix."""
    from scipy.linalg.lapack import dpstrf  # noqa: PLC0415 (slow to import)

    used = np.flatnonzero(loss.diagonal())
    factor, pivots, rank, _ = dpstrf(loss[used[:, None], used], lower=True)
    root = np.zeros((rank, len(loss)))
    unpivot(factor.T, used[pivots - 1], root)
    return root, np.ones(rank)


def _by_eigenvalues(part: Array) -> tuple[Array, Array]:
    """Eigenvalue decomposition of a symmetric matrix."""
    if not len(part):
        return part, np.empty(0)
    values, vectors = np.linalg.eigh(part)
    least = np.finfo(np.float64).eps * len(part) * np.abs(values).max()
    large = np.abs(values) > least
    root = (vectors[:, large] * np.sqrt(np.abs(values[large]))).T
    return root, np.sign(values[large])
