"""GTSAM's smoothers on a graph that grows by a pose and a scan at every step.

`GtsamSlam` builds the graph; its subclasses solve it incrementally, with a fixed lag,
or in a batch.  In GTSAM's coordinates of a pose, which are those of the robot's own
frame::

    t = t̂ + R(θ̂) v,    θ = θ̂ + ω

where (t̂, θ̂) is where the library linearised: in iSAM2 not yet its estimate.  The
odometry factor x_k⁻¹ x_{k+1} = (d, 0, α) has its noise in the frame of the new
heading: its covariance is R(α)ᵀ diag(σx², σy²) R(α) and σα².
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...arrays import Array
from ..guards import saved_states
from ..models.bearing_range import locate_landmark
from ..models.rigid_motion import pose_rotation
from . import peer_slam

X, L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L

LEAST_VARIANCE = 1e-10  # of motion noise [m², m², rad²]: GTSAM takes no certain motion
PoseAndPlaces = tuple[Any, list[Array]]
MOVE, READING, SOLVE = 0.0, 1.0, 2.0  # kinds of the events of a drive


class GtsamSlam(peer_slam.PeerSlam):
    """A smoother of GTSAM, its graph solved after every scan.

    Its factors are GTSAM's own: ``PriorFactorPose2``, ``BetweenFactorPose2`` and
    ``BearingRangeFactor2D``.  The belief is the joint marginal of the last pose and all
    landmarks, as the library linearised it.

    Parameters
    ----------
    motion_std, measurement_std, **settings
        As in :class:`.peer_slam.PeerSlam`.
    innovations : bool
        Whether reports have innovations and NIS.  They take the joint marginal before
        each scan, which costs more than the solution.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        innovations: bool = True,
        **settings: Any,
    ) -> None:
        self._innovations = argument_checks.flag("innovations", innovations)
        super().__init__(motion_std, measurement_std, **settings)

    def _start(self, pose: Array, std: Array) -> None:
        self._begin()
        self._graph, self._guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._events: list[tuple[float, ...]] = []
        self._moves: list[tuple[Array, Array]] = []
        self._k = self._solved_k = 0
        self._estimate = self._solved = pose
        self._covariance: Array | None = np.diag(std**2)
        self._first = np.stack([pose, std])
        own = pose_rotation(pose[2])
        noise = gtsam.noiseModel.Gaussian.Covariance((own.T * std**2) @ own)
        self._graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(*pose), noise))
        self._guess.insert(X(0), gtsam.Pose2(*pose))

    def _move(self, odometry: Array, variance: Array) -> None:
        self._events.append((MOVE, *odometry, *variance))
        self._moves.append((odometry, variance))
        turned = pose_rotation(odometry[2])
        covariance = (turned.T * np.maximum(variance, LEAST_VARIANCE)) @ turned
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        between = gtsam.Pose2(*odometry)
        before, now = X(self._k), X(self._k + 1)
        self._graph.add(gtsam.BetweenFactorPose2(before, now, between, noise))
        self._k += 1
        self._estimate = peer_slam.moved_state(self._estimate, odometry)[0]
        self._guess.insert(now, gtsam.Pose2(*self._estimate[:3]))

    def _take_in(
        self, known: peer_slam.Readings, new: peer_slam.Readings
    ) -> peer_slam.Innovation | None:
        if not len(known.slots) + len(new.slots):
            return None
        innovation = None
        if self._innovations and len(known.slots):
            innovation = self._innovation(known)
        found = locate_landmark(self._estimate[:3], new.measurements).position
        self._estimate = np.concatenate([self._estimate, found.ravel()])
        for slot, place in zip(new.slots, found, strict=True):
            self._guess.insert(L(slot), place)
        for readings in (known, new):
            self._add_readings(readings)
        self._solve()
        return innovation

    def _add_readings(self, readings: peer_slam.Readings) -> None:
        for (bearing, distance), slot, variance in zip(*readings, strict=True):
            self._events.append((READING, bearing, distance, *variance, slot, 0.0))
            noise = gtsam.noiseModel.Diagonal.Variances(variance)
            self._graph.add(
                gtsam.BearingRangeFactor2D(
                    X(self._k), L(slot), gtsam.Rot2(bearing), distance, noise
                )
            )

    def _solve(self) -> None:
        """Give the library what is new, and read its estimate."""
        self._events.append((SOLVE, *[0.0] * 6))
        n = len(self._estimate[3:]) // 2
        self._optimise(self._graph, self._guess, n)
        self._graph, self._guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose, places = self._found(X(self._k), [L(slot) for slot in range(n)])
        self._estimate = np.array([pose.x(), pose.y(), pose.theta(), *np.ravel(places)])
        self._solved, self._solved_k = self._estimate, self._k
        self._moves, self._covariance = [], None

    def _innovation(self, readings: peer_slam.Readings) -> peer_slam.Innovation:
        """Return ν and S at the last marginal, moved as an EKF moves it."""
        mean, P = self._solved, self._solved_covariance()
        for odometry, variance in self._moves:
            moved, G = peer_slam.moved_state(mean, odometry)
            P = G @ P @ G.T + peer_slam.motion_covariance(mean, variance)
            mean = moved
        expected, H = peer_slam.expected_readings(mean, readings.slots)
        nu = peer_slam.wrapped((readings.measurements - expected).ravel()).reshape(
            -1, 2
        )
        return peer_slam.Innovation(
            nu, H @ P @ H.T + np.diag(readings.variances.ravel())
        )

    def _mean(self) -> Array:
        return self._estimate

    def _moments(self) -> tuple[Array, Array]:
        if self._moves:
            self._solve()
        return self._estimate, self._solved_covariance()

    def _solved_covariance(self) -> Array:
        """Return the joint marginal at the last solution, of the additive error."""
        if self._covariance is None:
            n = len(self._solved)
            keys = [X(self._solved_k), *(L(slot) for slot in range((n - 3) // 2))]
            covariance, values = self._joint(keys)
            turn = np.eye(n)
            turn[:3, :3] = pose_rotation(values.atPose2(keys[0]).theta())
            self._covariance = turn @ covariance @ turn.T
        return self._covariance

    def state_dict(self) -> dict[str, Any]:
        """Return the drive until now, from which a smoother solves anew."""
        return {
            "estimator": type(self).__name__,
            "first_pose": self._first.copy(),
            "events": np.array(self._events, dtype=np.float64).reshape(-1, 7),
            "landmark_ids": np.array(self.landmark_ids, dtype=np.int64),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state: repeat its drive."""
        entries = ("first_pose", "events", "landmark_ids")
        saved_states.refuse_other_state(state, entries, estimator=type(self).__name__)
        ids = saved_states.landmark_ids("landmark_ids", state["landmark_ids"])
        pose, std = saved_states.array("first_pose", state["first_pose"], (2, 3))
        events = saved_states.array("events", state["events"], (-1, 7))
        self._slots = {i: slot for slot, i in enumerate(ids)}
        self._start(pose, std)
        rows: list[Array] = []
        for event in events:
            if event[0] == MOVE:
                self._move(event[1:4], event[4:])
            elif event[0] == READING:
                rows.append(event)
            else:
                self._repeat(np.array(rows).reshape(-1, 7))
                rows = []

    def _repeat(self, rows: Array) -> None:
        """Repeat a solution with the readings of a scan, or without any."""
        if not len(rows):
            self._solve()
            return
        slots = rows[:, 5].astype(np.int64)
        is_new = slots >= len(self._estimate[3:]) // 2
        known, new = (
            peer_slam.Readings(rows[which, 1:3], slots[which], rows[which, 3:5])
            for which in (~is_new, is_new)
        )
        self._take_in(known, new)

    @abstractmethod
    def _begin(self) -> None:
        """Make an empty solver."""

    @abstractmethod
    def _optimise(
        self, graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, landmarks: int
    ) -> None:
        """Add factors and first guesses to the solver, and solve."""

    @abstractmethod
    def _found(self, pose: int, landmarks: list[int]) -> PoseAndPlaces:
        """Return the estimates of a pose and of landmarks, by their keys."""

    @abstractmethod
    def _joint(self, keys: list[int]) -> tuple[Array, Any]:
        """Return the joint marginal of keys in GTSAM's coordinates, and about what."""


# --------------------------------------------------------------------------------------
# GTSAM's smoothers: incremental, with a fixed lag, and in a batch.
#
# They factorise by QR: where a motion noise is almost zero, Cholesky finds the system
# indeterminate.


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
        places = [self._solver.calculateEstimatePoint2(key) for key in landmarks]
        return self._solver.calculateEstimatePose2(pose), places

    def _joint(self, keys: list[int]) -> tuple[Array, Any]:
        return _joint_marginal(self._solver, keys)


class GtsamFixedLagSlam(GtsamIsam2Slam):
    """GTSAM's incremental fixed-lag smoother; the landmarks stay in it.

    Poses older than the lag are marginalised, as they are linearised then.

    Parameters
    ----------
    motion_std, measurement_std, **settings
        As in :class:`GtsamIsam2Slam`.
    lag : int
        Number of poses kept behind the last one.
    """

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        lag: int = 10,
        **settings: Any,
    ) -> None:
        self._lag = argument_checks.whole("lag", lag, 1)
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
