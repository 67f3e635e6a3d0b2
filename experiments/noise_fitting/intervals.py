"""Which parameters of a fit the readings determine, and how well."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from .scoring import Likelihoods, curvature, scores, totals

Verdict = Literal["fitted", "zero", "unknown"]

WITHIN = 1.92  # ½ χ²(1) at 95 %: how much less likely the ends of an interval are
NOT_ZERO = 1.35  # the same at 90 %, for a parameter that may lie at its end, zero
NORMAL = 1.96
VAGUE = 0.25  # a standard deviation of log σ above which zero is considered
FARTHEST = 10.0  # [m, rad] up to which an upper end is looked for
TRIED = 41  # values on the way


class Interval(NamedTuple):
    """What the readings say about one parameter."""

    verdict: Verdict
    """Zero: the interval begins at zero; "unknown": nothing depends on it."""
    low: float
    """Of the 95 % interval; 0 and infinity where unknown."""
    high: float


def intervals(likelihoods: Likelihoods, parameters: Array) -> list[Interval]:
    """Return the 95 % intervals of the most likely parameters.

    For a parameter that the readings determine, from the curvature of the log
    likelihood in log σ.  For another one, the upper end is where the readings are
    significantly less likely, with the others as they are.

    Parameters
    ----------
    likelihoods : callable
        Smooth, see :data:`.scoring.Likelihoods`.
    parameters : ndarray, shape (p,)
        Where it has its maximum.
    """
    theta = np.log(parameters)
    information = np.diag(scores(likelihoods, theta)[1])
    is_vague = information < 1 / VAGUE**2
    found = {
        i: _vague(likelihoods, parameters, i) for i in np.flatnonzero(is_vague).tolist()
    }
    sure = np.array([i for i in range(len(theta)) if not _is_open(found, i)], int)
    for i, width in zip(
        sure.tolist(), _widths(likelihoods, theta, sure, information), strict=True
    ):
        spread = np.exp(NORMAL * width)
        low, high = parameters[i] / spread, parameters[i] * spread
        found[i] = Interval("fitted", float(low), float(high))
    return [found[i] for i in range(len(theta))]


def _is_open(found: dict[int, Interval], i: int) -> bool:
    return i in found and found[i].verdict != "fitted"


def _vague(likelihoods: Likelihoods, parameters: Array, i: int) -> Interval:
    """Judge a poorly determined parameter by the likelihood along it."""
    tried = np.tile(parameters, (TRIED + 1, 1))
    tried[1:, i] = np.geomspace(parameters[i], max(FARTHEST, parameters[i]), TRIED)
    tried[0, i] = 0.0
    at_zero, *above = totals(likelihoods(tried))
    most = above[0]
    beyond = np.flatnonzero(np.array(above) < most - WITHIN)
    high = float(tried[1 + beyond[0], i]) if len(beyond) else np.inf
    if at_zero < most - NOT_ZERO:
        return Interval("fitted", 0.0, high)
    return Interval("zero" if len(beyond) else "unknown", 0.0, high)


def _widths(
    likelihoods: Likelihoods, theta: Array, chosen: IntArray, information: Array
) -> Array:
    """Return standard deviations of some θ, by the curvature in them."""
    if not len(chosen):
        return np.empty(0)

    def along(parameters: Array) -> Array:
        whole = np.tile(np.exp(theta), (len(parameters), 1))
        whole[:, chosen] = parameters
        return likelihoods(whole)

    steps = np.clip(0.5 / np.sqrt(information[chosen]), 0.005, 0.1)
    bent = curvature(along, theta[chosen], steps)
    if not (np.linalg.eigvalsh(bent) > 0).all():
        bent = scores(along, theta[chosen])[1]
    return np.asarray(np.sqrt(np.diag(np.linalg.pinv(bent))))
