"""The observability-constrained EKF-SLAM: projected Jacobians."""

from typing import ClassVar

from ..kernels.rules import PROJECTED
from .ekf import EkfSlam


class ObservabilityConstrainedEkfSlam(EkfSlam):
    """Observability-constrained EKF: Jacobians at the latest estimate, projected.

    H is evaluated at the latest estimate.  The projection removes its component along
    w, the rotation of the whole map at the first estimates of the landmarks [1]_ [2]_::

        H ← H − (H w) wᵀ / wᵀw

    G is that of :class:`FirstEstimatesEkfSlam`.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for
       designing consistent EKF SLAM estimators, IJRR 29(5), 2010.
    .. [2] J. Hesch, D. Kottas, S. Bowman, S. Roumeliotis, Consistency analysis and
       improvement of vision-aided inertial navigation, IEEE T-RO 30(1), 2014.
    """

    _linearisation: ClassVar[int] = PROJECTED
