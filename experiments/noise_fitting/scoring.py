"""Maximum likelihood of positive parameters by scoring, several values at a time.

Symbols
-------
θ      logarithms of the p parameters
ℓ_s    log likelihood of step s given those before; ℓ = Σ ℓ_s
g_s    its score ∂ℓ_s/∂θ, by central differences
I      Σ g_s g_sᵀ, the outer product of scores, which estimates the information
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...arrays import Array

Likelihoods = Callable[[Array], Array]
"""Of parameters (B, p), the log likelihoods (B, S) of the steps."""

NARROW = 0.01  # step of the differences, in θ
FARTHEST = 1.5  # the most that an iteration changes one θ
SHARES = (1.5, 1.0, 0.5, 0.2, 0.05)  # of the step that are tried at once
FAINT = 0.05  # information on θ beside which that of the readings is none
GAIN = 1e-3  # in ℓ, below which an iteration ends the search
MOST = 60  # iterations
LEAST, GREATEST = 1e-7, 1e3  # of a parameter


class Maximum(NamedTuple):
    """The most likely parameters."""

    parameters: Array
    """Shape (p,)."""
    log_likelihood: float
    converged: bool
    passes: int
    """How many values were tried."""


def maximise(
    likelihoods: Likelihoods, starts: Array, *, most: int | None = None
) -> Maximum:
    """Find the most likely parameters by scoring (Berndt et al. [1]_).

    ::

        θ ← θ + a (I + λ diag I)⁻¹ Σ g_s

    with the best of several a.  The damping λ grows where none is better.  A parameter
    on which nothing depends keeps its value.

    Parameters
    ----------
    likelihoods : callable
        See :data:`Likelihoods`.
    starts : ndarray, shape (k, p)
        Parameters > 0; the search begins at the most likely of them.
    most : int, optional
        Iterations, `MOST` where not given.

    Raises
    ------
    numpy.linalg.LinAlgError
        If no start has a finite likelihood.

    References
    ----------
    .. [1] E. Berndt, B. Hall, R. Hall, J. Hausman, Estimation and inference in
       nonlinear structural models, Annals of Economic and Social Measurement 3(4),
       1974.
    """
    values = totals(likelihoods(starts))
    best = int(np.argmax(values))
    if not np.isfinite(values[best]):
        raise np.linalg.LinAlgError("the readings are impossible under every noise")
    theta, value, passes = np.log(starts[best]), float(values[best]), len(starts)
    damping, converged = 1e-3, False
    for _ in range(MOST if most is None else most):
        gradient, information = scores(likelihoods, theta)
        passes += 2 * len(theta)
        step = _step(gradient, information, damping)
        if 0.5 * float(gradient @ step) < GAIN:
            converged = True
            break
        tried = theta + np.outer(SHARES, step)
        tried = np.clip(tried, np.log(LEAST), np.log(GREATEST))
        found = totals(likelihoods(np.exp(tried)))
        passes += len(tried)
        best = int(np.argmax(found))
        if not found[best] > value:
            damping *= 30
        else:
            damping *= 0.2 if SHARES[best] >= 0.5 else 4
            theta, value = tried[best], float(found[best])
        if damping > 1e4:
            break
    return Maximum(np.exp(theta), value, converged, passes)


def scores(likelihoods: Likelihoods, theta: Array) -> tuple[Array, Array]:
    """Return the gradient Σ g_s, shape (p,), and I, shape (p, p)."""
    offsets = NARROW * np.eye(len(theta))
    around = likelihoods(np.exp(np.concatenate([theta + offsets, theta - offsets])))
    above, below = around[: len(theta)], around[len(theta) :]
    usable = np.isfinite(above) & np.isfinite(below)
    slopes = np.where(usable, above - below, 0.0) / (2 * NARROW)
    return slopes.sum(axis=1), slopes @ slopes.T


def curvature(likelihoods: Likelihoods, theta: Array, widths: Array) -> Array:
    """Return −∂²ℓ/∂θ², shape (p, p), by differences of these widths (p,)."""
    p = len(theta)
    pairs = [(i, j) for i in range(p) for j in range(i, p)]
    points = [theta]
    for i, j in pairs:
        a, b = widths[i] * np.eye(p)[i], widths[j] * np.eye(p)[j]
        points += [theta + a + b, theta + a - b, theta - a + b, theta - a - b]
    values = totals(likelihoods(np.exp(np.array(points))))
    result = np.empty((p, p))
    for k, (i, j) in enumerate(pairs):
        pp, pm, mp, mm = values[1 + 4 * k : 5 + 4 * k]
        result[i, j] = result[j, i] = -(pp - pm - mp + mm) / (4 * widths[i] * widths[j])
    return result


def totals(likelihoods: Array) -> Array:
    """Return ℓ of each value; -inf where it is not a number."""
    sums = likelihoods.sum(axis=1)
    return np.where(np.isnan(sums), -np.inf, sums)


def _step(gradient: Array, information: Array, damping: float) -> Array:
    """Return the step of θ, none of whose entries exceeds FARTHEST."""
    weights = damping * np.diag(information) + FAINT
    step = np.linalg.solve(information + np.diag(weights), gradient)
    return np.asarray(np.clip(step, -FARTHEST, FARTHEST))
