"""The right-invariant EKF-SLAM, which stays consistent if the heading is uncertain."""

from __future__ import annotations

from typing import Any, ClassVar

from numpy.typing import ArrayLike

from ..kernels.rules import INVARIANT
from ..support import argument_checks
from .ekf import EkfSlam


class InvariantEkfSlam(EkfSlam):
    """Right-invariant EKF, the recommended filter.

    The error ξ = Log(χ χ̂⁻¹) is on SE_{1+n}(2).  A rotation of the whole map is a
    straight line in it, so the filter gains no information about its absolute heading,
    however often it linearises [1]_ [2]_.  Mean and covariance are stored in ordinary
    coordinates.  Up to the gain, the filter equals the standard one.  With
    δ = Aᵀ L⁻¹ ν, t = δθ and J = [0 −1; 1 0], for the position and every landmark q::

        retraction   q ← R(t) q + V(t) (δq − t J q),   θ ← θ + t
        transport    P ← P + v cᵀ + c vᵀ + c_θ v vᵀ,   v = J (q⁺ − q), c = P e_θ

    Propagation costs O(n), and the additive covariance is always available.

    Parameters
    ----------
    motion_std, measurement_std
        As in :class:`EkfSlam`.
    iterations : int
        Number of linearisations of a scan, with the same prior; more than one for
        coarse sensors.  The heading column of H remains that of the prior, because the
        exact Gauss-Newton column would make the heading observable.
    sequential : bool
        Process one landmark after the other instead of the whole scan at once, for
        heading errors of half a radian and more.  The order of readings then matters.
    **settings
        The other keywords of :class:`EkfSlam`.

    References
    ----------
    .. [1] A. Barrau, S. Bonnabel, An EKF-SLAM algorithm with consistency properties,
       arXiv 1510.06263, 2015.
    .. [2] T. Zhang, K. Wu, J. Song, S. Huang, G. Dissanayake, Convergence and
       consistency analysis for a 3-D invariant-EKF SLAM, RA-L 2017.

    Examples
    --------
    A robot at rest gains no information about its heading:

    >>> slam = InvariantEkfSlam((0, 0, 0), (0.03, 0.1), initial_pose_std=(0, 0, 0.3))
    >>> for _ in range(100):
    ...     _ = slam.update([(0.5, 4.0)], [0])
    >>> round(float(slam.belief().pose_covariance[2, 2]) ** 0.5, 12)
    0.3
    """

    _frame: ClassVar[int] = INVARIANT

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        iterations: int = 1,
        sequential: bool = False,
        **settings: Any,
    ) -> None:
        super().__init__(motion_std, measurement_std, **settings)
        rules = self.rules._replace(
            iterations=argument_checks.whole("iterations", iterations, 1),
            sequential=argument_checks.flag("sequential", sequential),
        )
        self._adopt(rules)
