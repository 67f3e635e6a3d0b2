"""GTSAM's smoothers: incremental, with a fixed lag, and in a batch.

They factorise by QR: where a motion noise is almost zero, Cholesky finds the system
indeterminate.
"""

from __future__ import annotations

from typing import Any

import gtsam
from numpy.typing import ArrayLike

from ...arrays import Array
from ..support import argument_checks
from .gtsam_graph import GtsamSlam, L, PoseAndPlaces, X


class GtsamIsam2Slam(GtsamSlam):
    """GTSAM's incremental smoother iSAM2: one update per scan.

    Parameters
    ----------
    motion_std, measurement_std, **settings
        As in :class:`GtsamSlam`.
    relinearize_threshold : float
        A variable is linearised anew where its step is larger [m, rad].
    relinearize_skip : int
        At every how many updates that is looked at.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        relinearize_threshold: float = 0.1,
        relinearize_skip: int = 1,
        **settings: Any,
    ) -> None:
        self._parameters = _isam2_parameters(relinearize_threshold, relinearize_skip)
        super().__init__(motion_std, measurement_std, **settings)

    def _begin(self) -> None:
        self._solver = gtsam.ISAM2(self._parameters)

    def _optimise(
        self, graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, landmarks: int
    ) -> None:
        self._solver.update(graph, guess)

    def _found(self, pose: int, landmarks: list[int]) -> PoseAndPlaces:
        return _estimates(self._solver, pose, landmarks)

    def _joint(self, keys: list[int]) -> tuple[Array, Any]:
        return _joint_marginal(self._solver, keys)


class GtsamFixedLagSlam(GtsamSlam):
    """GTSAM's incremental fixed-lag smoother; the landmarks stay in it.

    Poses older than the lag are marginalised, as they are linearised then.

    Parameters
    ----------
    motion_std, measurement_std, **settings
        As in :class:`GtsamSlam`.
    lag : int
        Number of poses kept behind the last one.
    relinearize_threshold, relinearize_skip
        As in :class:`GtsamIsam2Slam`.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        lag: int = 10,
        relinearize_threshold: float = 0.1,
        relinearize_skip: int = 1,
        **settings: Any,
    ) -> None:
        self._lag = argument_checks.whole("lag", lag, 1)
        self._parameters = _isam2_parameters(relinearize_threshold, relinearize_skip)
        super().__init__(motion_std, measurement_std, **settings)

    def _begin(self) -> None:
        self._solver = gtsam.IncrementalFixedLagSmoother(
            float(self._lag), self._parameters
        )

    def _optimise(
        self, graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, landmarks: int
    ) -> None:
        times = {X(k): float(k) for k in range(self._solved_k, self._k + 1)}
        times |= {L(slot): float(self._k) for slot in range(landmarks)}
        self._solver.update(graph, guess, times)

    def _found(self, pose: int, landmarks: list[int]) -> PoseAndPlaces:
        return _estimates(self._solver, pose, landmarks)

    def _joint(self, keys: list[int]) -> tuple[Array, Any]:
        return _joint_marginal(self._solver.getISAM2(), keys)


class GtsamBatchSlam(GtsamSlam):
    """GTSAM's Levenberg-Marquardt over the whole drive after every scan.

    It starts at the last solution, and has the library's own parameters.  The marginals
    are those of a new iSAM2 linearised there, because ``gtsam.Marginals`` has no QR.
    The time of a step grows with the drive.

    Parameters are those of :class:`GtsamSlam`.
    """

    def _begin(self) -> None:
        self._drive, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._parameters = gtsam.LevenbergMarquardtParams()
        self._parameters.setLinearSolverType("MULTIFRONTAL_QR")

    def _optimise(
        self, graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, landmarks: int
    ) -> None:
        self._drive.push_back(graph)
        self._values.insert(guess)
        self._values = gtsam.LevenbergMarquardtOptimizer(
            self._drive, self._values, self._parameters
        ).optimize()

    def _found(self, pose: int, landmarks: list[int]) -> PoseAndPlaces:
        values = self._values
        return values.atPose2(pose), [values.atPoint2(key) for key in landmarks]

    def _joint(self, keys: list[int]) -> tuple[Array, Any]:
        isam = gtsam.ISAM2(_isam2_parameters(0.1, 1))
        isam.update(self._drive, self._values)
        return _joint_marginal(isam, keys)


def _isam2_parameters(threshold: float, skip: int) -> gtsam.ISAM2Params:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(
        argument_checks.at_least("relinearize_threshold", threshold, 0)
    )
    parameters.relinearizeSkip = argument_checks.whole("relinearize_skip", skip, 1)
    parameters.setFactorization("QR")
    return parameters


def _joint_marginal(isam: gtsam.ISAM2, keys: list[int]) -> tuple[Array, Any]:
    """Return the marginal about the linearisation point, from which iSAM2 steps."""
    covariance = isam.jointMarginalCovariance(keys).fullMatrix()
    return covariance, isam.getLinearizationPoint()


def _estimates(solver: Any, pose: int, landmarks: list[int]) -> PoseAndPlaces:
    places = [solver.calculateEstimatePoint2(key) for key in landmarks]
    return solver.calculateEstimatePose2(pose), places
