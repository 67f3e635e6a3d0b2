"""The iterated EKF-SLAM: Gauss-Newton inside the update."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from ..support import argument_checks
from .ekf import EkfSlam


class IteratedEkfSlam(EkfSlam):
    """Iterated EKF: linearise again at each iterate, condition once.

    The update is the Gauss-Newton method on one scan and its prior [1]_::

        x_{i+1} = x_0 + K_i (z − h(x_i) − H_i (x_0 − x_i)),   x_0, P the prior
        P ← (I − K H) P with the last H

    Every iteration uses the same prior, so the result of a linear problem is exact
    for any number of iterations.  The filter suits precise sensors with strongly
    nonlinear measurements.  Its heading is as overconfident as that of ``ekf``.

    Parameters
    ----------
    motion_std, measurement_std
        As in :class:`EkfSlam`.
    iterations : int
        Linearisations per scan; 1 is the standard filter.
    **settings
        The other keywords of :class:`EkfSlam`.

    References
    ----------
    .. [1] B. Bell, F. Cathey, The iterated Kalman filter update as a Gauss-Newton
       method, IEEE TAC 38(2), 1993.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        iterations: int = 3,
        **settings: Any,
    ) -> None:
        super().__init__(motion_std, measurement_std, **settings)
        count = argument_checks.whole("iterations", iterations, 1)
        self._adopt(self.rules._replace(iterations=count))
