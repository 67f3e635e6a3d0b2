"""Gauss-Newton iteration with step halving and Anderson acceleration."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ....arrays import Array

ITERATIONS, HALVINGS, MEMORY = 200, 8, 5
PATIENCE = 30
"""Iterations after which an extrapolated step only has to lower the cost.

Where large errors remain at the solution, as after improbable readings, plain steps
approach it slowly, and their decrement rises and falls on the way.
"""


class Iterate(NamedTuple):
    """One iterate of Gauss-Newton."""

    values: Array
    """All unknowns, shape (N,)."""
    cost: float
    """Sum of the squared errors, in standard deviations."""
    decrement: float
    """Decrease of the cost by a full step in a linear problem."""
    step: Array

    @property
    def largest_cost(self) -> float:
        """Largest cost that the next iterate may have, allowing for rounding."""
        return self.cost * (1 + 1e-9) + 1e-9


def minimise(
    evaluate: Callable[[Array], Iterate], values: Array, converged: float
) -> bool:
    """Iterate until the decrement is small; return whether that succeeded.

    Parameters
    ----------
    evaluate : callable
        Linearises the problem at given values.  Its last call is at the result.
    values : ndarray, shape (N,)
        Where to begin.
    converged : float
        The decrement at which to stop.
    """
    now = evaluate(values)
    past: list[Iterate] = []
    for iteration in range(ITERATIONS):
        if now.decrement <= converged:
            return True
        past = [*past[-MEMORY:], now] if now.decrement < 1 else []
        largest = np.inf if iteration >= PATIENCE else now.decrement
        trial = _accelerated(evaluate, past, largest)
        now = _descend(evaluate, now) if trial is None else trial
    return False


def _accelerated(
    evaluate: Callable[[Array], Iterate], past: list[Iterate], largest: float
) -> Iterate | None:
    """Step from the last iterates; None where that lowers too little."""
    if len(past) < 2:
        return None
    now = past[-1]
    trial = evaluate(now.values + accelerated(past))
    is_better = trial.cost <= now.largest_cost and trial.decrement < largest
    return trial if is_better else None


def _descend(evaluate: Callable[[Array], Iterate], now: Iterate) -> Iterate:
    """Take the largest of the halved steps that does not increase the cost."""
    for halving in range(HALVINGS):
        trial = evaluate(now.values + now.step / 2**halving)
        if trial.cost <= now.largest_cost:
            break
    return trial


def accelerated(past: Sequence[Iterate]) -> Array:
    """Return a step extrapolated from the last iterates (Anderson acceleration [1]_).

    Parameters
    ----------
    past : sequence of Iterate
        The last iterates, two or more.

    References
    ----------
    .. [1] D. G. Anderson, Iterative procedures for nonlinear integral equations,
       Journal of the ACM 12(4), 1965.

    Examples
    --------
    Each step of this iteration is half the previous one; the limit is 8:

    >>> values = [0.0, 4.0]
    >>> past = [Iterate(np.array([v]), 0, 0, np.array([(8 - v) / 2])) for v in values]
    >>> (values[-1] + accelerated(past)).round(12)
    array([8.])
    """
    moves = np.diff([iterate.values for iterate in past], axis=0)
    changes = np.diff([iterate.step for iterate in past], axis=0)
    step = past[-1].step
    weights = np.linalg.lstsq(changes.T, step)[0]
    return np.asarray(step - weights @ (moves + changes))
