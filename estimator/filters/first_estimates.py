"""The first-estimates EKF-SLAM: Jacobians at fixed linearisation points."""

from typing import ClassVar

from ..kernels.rules import AT_REFERENCE
from .ekf import EkfSlam


class FirstEstimatesEkfSlam(EkfSlam):
    """First-estimates-Jacobian EKF: the standard filter, linearised at fixed points.

    The Jacobians are evaluated at the first estimate of each landmark and at the
    predicted pose, even if later estimates are better [1]_::

        G = I + (−(ŷ⁻ₖ₊₁ − ŷ⁻ₖ), x̂⁻ₖ₊₁ − x̂⁻ₖ, 0, …) e_θᵀ,   x̂⁻ predicted
        H = ∂h at (x̂⁻ₖ, first l̂)

    No row of the stacked observability matrix then observes the rotation of the whole
    map, and the heading gains no spurious information.  Poor first estimates are kept,
    so some runs diverge with coarse sensors.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for
       designing consistent EKF SLAM estimators, IJRR 29(5), 2010.
    """

    _linearisation: ClassVar[int] = AT_REFERENCE
