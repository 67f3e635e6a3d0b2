"""The observability-constrained EKF-SLAM: projected Jacobians."""

from typing import ClassVar

from ..kernels.rules import PROJECTED
from .ekf import EkfSlam


class ObservabilityConstrainedEkfSlam(EkfSlam):
    """Observability-constrained EKF: the best linearisation, made blind by projection.

    H is taken at the present estimate and projected off the direction w in which the
    whole map turns, as it was when the landmark was first seen [1]_ [2]_::

        H ← H − (H w) wᵀ / wᵀw

    with G as in :class:`FirstEstimatesEkfSlam`.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for
       designing consistent EKF SLAM estimators, IJRR 29(5), 2010.
    .. [2] J. Hesch, D. Kottas, S. Bowman, S. Roumeliotis, Consistency analysis and
       improvement of vision-aided inertial navigation, IEEE T-RO 30(1), 2014.
    """

    _linearisation: ClassVar[int] = PROJECTED
