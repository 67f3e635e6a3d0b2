"""What a local map remembers of its phase for the rest of the map: exact deferral.

Let S (s, width) be the covariance, at the beginning of a phase, of the s local
coordinates x_a (pose and local landmarks) with everything else, x_b.  In the phase
only x_a is read.  The ordinary filter then runs on an extended state (x_a, y)::

    mean (x_a, 0),   covariance [P_aa  I; I  0]

in which y stands for coordinates of which x_b is a linear function, x_b = S ᵀ y + what
does not change.  Whatever the phase brought, with its end result [P_aa Φ; Φᵀ −Ψ]::

    x_b ← x_b + Sᵀ y,   P_ab ← Φ S,   P_bb ← P_bb − Sᵀ Ψ S

(Guivant and Nebot, 2001, in the form of an augmented state.)

In the invariant frame a correction also turns and shears points,
q⁺ = q + V(t) δq, and the covariance is transported, P ← T P Tᵀ, e_q⁺ = e_q + J (q⁺ − q)
e_θ.  Both are linear in q read as a complex number, J = i.  So there y is a complex
number for each of the s coordinates, a *virtual landmark* at the origin, and with x_b
and the rows of S read as complex numbers all of the above holds as it stands.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Phase(NamedTuple):
    """The end result of a phase, cut into its parts."""

    mean: Array  # (a,) of pose and local landmarks
    covariance: Array  # P_aa, (a, a)
    gain: Array  # Φ, (a, e)
    loss: Array  # Ψ, (e, e)
    shift: Array  # y, (1, e)


def virtual_landmarks(coordinates: int, invariant: bool) -> int:
    """How many landmarks the extension takes the place of."""
    return coordinates if invariant else (coordinates + 1) // 2


def extend(mean: Array, covariance: Array, invariant: bool) -> tuple[Array, Array]:
    """Put the extension between pose and landmarks; return mean and covariance."""
    s = len(mean)
    e = 2 * virtual_landmarks(s, invariant)
    real = np.r_[0:3, 3 + e : s + e]
    long_mean, extended = np.zeros(s + e), np.zeros((s + e, s + e))
    long_mean[real] = mean
    extended[np.ix_(real, real)] = covariance
    columns = 3 + np.arange(s) * (2 if invariant else 1)
    extended[real, columns] = extended[columns, real] = 1.0
    return long_mean, extended


def cut(mean: Array, covariance: Array, virtual: int) -> Phase:
    """Take apart the belief of a filter that ran on an extended state."""
    pose, extension, rest = slice(0, 3), slice(3, 3 + 2 * virtual), 3 + 2 * virtual
    rows = np.concatenate([covariance[pose], covariance[rest:]])
    return Phase(
        np.concatenate([mean[pose], mean[rest:]]),
        np.concatenate([rows[:, pose], rows[:, rest:]], axis=1),
        np.ascontiguousarray(rows[:, extension]),
        -covariance[extension, extension],
        mean[None, extension].copy(),
    )


def combine(coefficients: Array, strip: Array, invariant: bool) -> Array:
    """Return Φ S, shape (k, width), of coefficients (k, e) and the strip (s, width)."""
    if not invariant:
        product: Array = coefficients[:, : len(strip)] @ strip
        return product
    turned = coefficients.view(np.complex128) @ strip.view(np.complex128)
    return turned.view(np.float64)


def roots(loss: Array, invariant: bool) -> tuple[Array, Array]:
    """Factor Ψ = U diag(s) Uᵀ at its numerical rank.

    Its rank is that of what was really read, well below its size.  Transport makes Ψ
    indefinite.

    Returns
    -------
    root : ndarray, shape (rank, e)
        Uᵀ.
    signs : ndarray, shape (rank,)
        s, each 1 or -1.
    """
    used = np.flatnonzero(loss.any(axis=0))
    part = loss[used[:, None], used]  # of which the lower half is read
    root, signs = _by_eigenvalues(part) if invariant else _by_pivots(part)
    rows = np.zeros((len(root), len(loss)))
    rows[:, used] = root
    return rows, signs


def _by_pivots(part: Array) -> tuple[Array, Array]:
    """Pivoted Cholesky decomposition of a semidefinite matrix."""
    from scipy.linalg.lapack import dpstrf  # noqa: PLC0415 (slow to import)

    factor, pivots, rank, _ = dpstrf(part, lower=True)
    root = np.zeros((rank, len(part)))
    root[:, pivots - 1] = np.tril(factor)[:, :rank].T
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
