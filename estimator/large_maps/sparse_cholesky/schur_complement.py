"""Elimination of the landmarks around a local map from a sparse information matrix."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from ....arrays import Array, IntArray
from .information_matrix import InformationMatrix

Solver = Callable[[Array], Array]

LARGEST_DENSE = 150
"""Up to this many landmarks, a dense Cholesky factor is faster than a sparse one."""


class Factor(Protocol):
    """Factor of Λ_HH, which is made when it is first used."""

    def solve(self, right: Array) -> Array:
        """Return Λ_HH⁻¹ b."""
        ...

    def respond(self, shift: Array) -> Array:
        """Return T δ_B."""
        ...

    def release(self) -> None:
        """Free the memory of the factor; the next use makes it again."""


class SchurComplement(NamedTuple):
    """Effect of eliminated landmarks H on a local map L.

    ::

        Λ_LL δ_L + Λ_LH δ_H = b_L,   Λ_HL δ_L + Λ_HH δ_H = 0
        ⟹ (Λ_LL − C) δ_L = b_L,   δ_H = −T δ_B,   T = Λ_HH⁻¹ Λ_HB,   C = Λ_BH T

    where B ⊂ L are the local landmarks linked with H.
    """

    slots: IntArray
    """H."""
    border: IntArray
    """Columns of B in L, shape (c,)."""
    response: Array
    """T, shape (2h, c); not computed, (0, c), if H is the whole rest of the map."""
    complement: Array
    """C, shape (c, c), symmetric."""
    factor: Factor


class SubsetFactor:
    """Factor of the rows and columns of some landmarks."""

    def __init__(
        self,
        matrix: InformationMatrix,
        slots: IntArray,
        response: Array,
        solve: Solver | None = None,
    ) -> None:
        self._matrix, self._slots = matrix, slots
        self._response, self._solve = response, solve

    def solve(self, right: Array) -> Array:
        """Return Λ_HH⁻¹ b."""
        if self._solve is None:
            self._solve = solver(self._matrix, self._slots)
        return self._solve(right)

    def respond(self, shift: Array) -> Array:
        """Return T δ_B."""
        return np.asarray(self._response @ shift)

    def release(self) -> None:
        """Free the memory of the factor."""
        self._solve = None


def eliminate_subset(
    matrix: InformationMatrix, local: IntArray, subset: IntArray
) -> SchurComplement:
    """Eliminate some landmarks around a local map.

    Raises
    ------
    numpy.linalg.LinAlgError
        If their information is not positive definite.
    """
    link = matrix.submatrix(subset, local).tocsc()
    border = np.flatnonzero(np.diff(link.indptr))
    right = link[:, border].toarray()
    solve = solver(matrix, subset)
    # One memory layout: BLAS must return the same bits after a state is reloaded.
    response = np.ascontiguousarray(solve(right) if len(border) else right)
    complement = right.T @ response
    return SchurComplement(
        subset,
        border,
        response,
        (complement + complement.T) / 2,
        SubsetFactor(matrix, subset, response, solve),
    )


def solver(matrix: InformationMatrix, slots: IntArray) -> Solver:
    """Factorise the rows and columns of some landmarks."""
    if not len(slots):
        return np.copy
    if len(slots) <= LARGEST_DENSE:
        factor = cho_factor(matrix.dense(slots), lower=True, check_finite=False)
        return lambda right: np.asarray(cho_solve(factor, right, check_finite=False))
    return _sparse_solver(matrix.submatrix(slots, slots).tocsc())


def _sparse_solver(information: csc_array) -> Solver:
    """Factorise a sparse symmetric positive definite matrix."""
    try:
        factor = splu(
            information,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise np.linalg.LinAlgError(
            f"the information matrix is not positive definite: {error}"
        ) from error
    return lambda right: np.asarray(factor.solve(np.ascontiguousarray(right)))
