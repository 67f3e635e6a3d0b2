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

from ...arrays import Array, IntArray

Likelihoods = Callable[[Array], Array]
"""Of parameters (B, p), the log likelihoods (B, S) of the steps."""

NARROW = 0.01  # step of the differences, in θ
FARTHEST = 2.0  # the most that an iteration changes one θ
SHARES = (8.0, 3.0, 1.5, 1.0, 0.5, 0.15)  # of the step that are tried at once
FAINT = 0.05  # information on θ beside which that of the readings is none
LITTLE = 16.0  # information on θ, that of a standard deviation of ¼
GAIN = 1e-4  # in ℓ, below which an iteration ends a climb
BETTER = 1e-2  # in ℓ, from which on one value is more likely than another
MOST = 60  # iterations of a climb
CLIMBS = 8
LEAST, GREATEST = 1e-7, 1e3  # of a parameter
SIZES = 10.0 * 2.0 ** -np.arange(21)  # tried of a poorly determined parameter


class Maximum(NamedTuple):
    """The most likely parameters."""

    parameters: Array
    """Shape (p,)."""
    log_likelihood: float
    converged: bool
    passes: int
    """Number of values tried."""


class Scores(NamedTuple):
    """The log likelihood about one θ."""

    value: float
    """ℓ."""
    gradient: Array
    """Σ g_s, shape (p,)."""
    information: Array
    """I, shape (p, p)."""


class _Climb(NamedTuple):
    theta: Array
    scores: Scores
    converged: bool
    passes: int


def maximise(
    likelihoods: Likelihoods, starts: Array, *, most: int | None = None
) -> Maximum:
    """Find the most likely parameters by scoring (Berndt et al. [1]_).

    ::

        θ ← θ + a (I + λ diag I)⁻¹ Σ g_s

    with the best of several a. The damping λ increases if no step improves the
    likelihood. A parameter without effect keeps its value.

    As σ → 0, the slope along log σ vanishes like σ², whether zero is likely or not.
    When a climb ends, each poorly determined parameter is therefore tried with values
    of all sizes, and the climb continues from the best of them.

    Parameters
    ----------
    likelihoods : callable
        See :data:`Likelihoods`.
    starts : ndarray, shape (k, p)
        Parameters > 0; the search begins at the most likely of them.
    most : int, optional
        Iterations of a climb, `MOST` where not given.

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
    theta, passes = np.log(starts[best]), len(starts)
    for _ in range(CLIMBS):
        climb = _climb(likelihoods, theta, MOST if most is None else most)
        passes += climb.passes
        if not climb.converged:
            break
        tried = _of_other_sizes(climb)
        values = totals(likelihoods(np.exp(tried)))
        passes += len(tried)
        if not (values > climb.scores.value + BETTER).any():
            break
        theta = tried[int(np.argmax(values))]
    return Maximum(np.exp(climb.theta), climb.scores.value, climb.converged, passes)


def _climb(likelihoods: Likelihoods, theta: Array, most: int) -> _Climb:
    damping, passes, here = 1e-3, 0, None
    for _ in range(most):
        if here is None:
            here = scores(likelihoods, theta)
            passes += 2 * len(theta) + 1
        step = _step(here, damping)
        if 0.5 * float(here.gradient @ step) < GAIN:
            return _Climb(theta, here, True, passes)
        if damping > 1e4:
            break
        steps = np.clip(np.outer(SHARES, step), -FARTHEST, FARTHEST)
        tried = np.clip(theta + steps, np.log(LEAST), np.log(GREATEST))
        found = totals(likelihoods(np.exp(tried)))
        passes += len(tried)
        best = int(np.argmax(found))
        if found[best] > here.value:
            damping *= 0.2 if SHARES[best] >= 0.5 else 4
            theta, here = tried[best], None
        else:
            damping *= 30
    if here is None:
        here = scores(likelihoods, theta)
    return _Climb(theta, here, False, passes)


def _of_other_sizes(climb: _Climb) -> Array:
    """Return θ with several values of each poorly determined entry, (B, p)."""
    little = np.flatnonzero(np.diag(climb.scores.information) < LITTLE)
    tried = np.tile(climb.theta, (len(little) * len(SIZES), 1))
    tried[np.arange(len(tried)), np.repeat(little, len(SIZES))] = np.tile(
        np.log(SIZES), len(little)
    )
    return tried


def scores(likelihoods: Likelihoods, theta: Array) -> Scores:
    """Return ℓ, its gradient and I at one θ, of 2p + 1 passes."""
    offsets, p = NARROW * np.eye(len(theta)), len(theta)
    tried = np.concatenate([theta[None], theta + offsets, theta - offsets])
    around = likelihoods(np.exp(tried))
    above, below = around[1 : p + 1], around[p + 1 :]
    usable = np.isfinite(above) & np.isfinite(below)
    slopes = np.zeros_like(above)
    slopes[usable] = (above[usable] - below[usable]) / (2 * NARROW)
    value = float(totals(around[:1])[0])
    return Scores(value, slopes.sum(axis=1), slopes @ slopes.T)


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


def restricted(
    likelihoods: Likelihoods, parameters: Array, chosen: IntArray
) -> Likelihoods:
    """Return the likelihoods as functions of some parameters, the others as given."""

    def along(some: Array) -> Array:
        whole = np.tile(parameters, (len(some), 1))
        whole[:, chosen] = some
        return likelihoods(whole)

    return along


def totals(likelihoods: Array) -> Array:
    """Return ℓ of each value; -inf if it is not a number."""
    sums = likelihoods.sum(axis=1)
    return np.where(np.isnan(sums), -np.inf, sums)


def _step(here: Scores, damping: float) -> Array:
    weights = damping * np.diag(here.information) + FAINT
    step = np.linalg.solve(here.information + np.diag(weights), here.gradient)
    return np.asarray(step, dtype=np.float64)
