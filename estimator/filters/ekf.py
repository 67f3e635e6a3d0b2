"""The family of EKF-SLAM filters on the shared kernels, and their settings.

`MapFilter` holds what all of them share: settings, map and saved state. `EkfSlam`, the
standard filter, predicts and updates. Its subclasses differ in where they linearise and
in their error frame: `InvariantEkfSlam`, `FirstEstimatesEkfSlam`,
`ObservabilityConstrainedEkfSlam` and `IteratedEkfSlam`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf, log1p
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import LandmarkIds, landmark_pairs, with_copies
from ...arrays import Array, IntArray
from ..beliefs import Belief, MapView, UpdateReport, describe_filter
from ..kernels import scan_update as scan
from ..kernels.scan_update import DONE, FRAMES, NOT_USABLE, BeliefArrays, Rules
from ..models.motions import UNICYCLE, Motion, MotionNoise
from ..models.rigid_motion import ErrorFrame
from ..models.sensors import BEARING_RANGE, DELAYED, Sensor, find_sensor, two_stds
from .gaussian_map import REPEATED, GaussianMap, UpdateKernel, move_pose, update_map

if TYPE_CHECKING:
    from .pose_readings import ObservedMap, PoseReading

#: How a new landmark enters the map.
LANDMARK_INITS = ("full", "independent", DELAYED)


class MapFilter:
    """A filter without its steps: reset, belief, saved state, map editing."""

    #: The belief, in the arrays that steps change.
    map: GaussianMap
    #: What distinguishes this filter's updates from another's.
    rules: Rules

    __repr__ = describe_filter

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map.

        Parameters
        ----------
        pose : array_like, shape (3,)
            Mean of the first pose (x, y, θ) [m, m, rad].
        pose_std : array_like, shape (3,)
            Its standard deviation.
        """
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        self.map.reset(first, np.diag(std**2))

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> UpdateReport:
        """Correct the belief with a reading of the pose, such as compass or GPS.

        The reading is z = H (x, y, θ) + w.  A compass has H = [0 0 1], a GPS
        H = [1 0 0; 0 1 0].

        Parameters
        ----------
        reading : array_like, shape (k,)
            z [m or rad]; a component that depends on the heading alone is an angle.
        matrix : array_like, shape (k, 3)
            H.
        covariance : array_like, shape (k, k)
            R, of the noise w; positive definite.

        Returns
        -------
        UpdateReport
            NIS, innovation (k,) and its covariance.  It has no degrees of freedom where
            the gate of the filter, if any, rejects the reading.

        Raises
        ------
        ValueError
            If an argument is malformed; the belief is then as before.

        Examples
        --------
        >>> from slamgym.estimator import InvariantEkfSlam
        >>> slam = InvariantEkfSlam((0, 0, 0), (0.1, 0.1), initial_pose_std=(1, 1, 1))
        >>> slam.observe_pose(0.5, [0, 0, 1], 1.0).degrees_of_freedom
        1
        >>> slam.belief().pose
        array([0.  , 0.  , 0.25])
        """
        from .pose_readings import PoseReading, gate_of  # noqa: PLC0415 (for few drives)

        given = PoseReading.checked(reading, matrix, covariance)
        mean, P, reference = self.map.used
        found = self._observe(given, mean, P)
        if not found.nis <= gate_of(self.rules, len(found.innovation)):
            return UpdateReport()
        after = BeliefArrays(found.mean, found.covariance, reference)
        block, report = self.map.blank(self.map.room), found.report()
        self.map.hold(after, self.map.slots, block=block, steps=1, report=report)
        return report

    def _observe(
        self, given: PoseReading, mean: Array, covariance: Array
    ) -> ObservedMap:
        once = self.rules.iterations == 1
        return given.correct(mean, covariance, frame=self.frame, once=once)

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Marginalise landmarks; the remaining belief is unchanged to the last bit.

        Raises
        ------
        ValueError
            If one is not in the map; nothing is removed.
        """
        self.map.remove(argument_checks.mapped_identities(landmark_ids, self.slots))

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two mapped landmarks being one, and remove the second.

        Raises
        ------
        ValueError
            If one is not in the map, or they are the same.
        numpy.linalg.LinAlgError
            If their distance has no uncertainty, or is far beyond it; nothing is
            merged.
        """
        self.merge_pairs([(kept, gone)])

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge several pairs (kept, gone) at once, as one measurement.

        Raises
        ------
        ValueError
            If a landmark is not in the map, or in two pairs.
        numpy.linalg.LinAlgError
            If a distance has no uncertainty, or is far beyond it; nothing is merged.
        """
        from .pose_readings import coincide  # noqa: PLC0415 (few drives merge)

        kept, gone = landmark_pairs(pairs, self.slots)
        (mean, P, reference), slots = self.map.used, self.map.slots
        at_estimate = self.rules.linearisation == scan.AT_ESTIMATE
        merged = coincide(
            mean,
            P,
            [slots[i] for i in kept],
            [slots[i] for i in gone],
            frame=self.frame,
            reference=None if at_estimate else reference,
        )
        self.map.keep_without(BeliefArrays(*merged, reference), gone)

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief as a snapshot, of the whole map or of a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Return the marginal of the pose and these landmarks only, in this order.
        """
        if landmark_ids is not None:
            landmark_ids = argument_checks.mapped_identities(landmark_ids, self.slots)
        return self.map.belief(self.frame, landmark_ids)

    def map_view(self) -> MapView:
        """Return pose and map without a copy; it is valid until the next step."""
        return self.map.view()

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self.slots)

    @property
    def slots(self) -> Mapping[int, int]:
        """Place of each landmark in the state: column 3 + 2 slot."""
        return self.map.landmark_slots

    @property
    def frame(self) -> ErrorFrame:
        """Coordinates in which the filter takes its error to be Gaussian."""
        return FRAMES[self.rules.frame]

    def state_dict(self) -> dict[str, Any]:
        """Return copies of mean, covariance, ids and linearisation points."""
        return {"estimator": np.array(type(self).__name__), **self.map.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit in a filter of the same settings.

        Parameters
        ----------
        state : mapping
            What :meth:`state_dict` returned, also after a trip through ``numpy.savez``.

        Raises
        ------
        ValueError
            If the state lacks an entry, belongs to another estimator, or does not fit
            together; the belief is then as before.
        """
        checked = self.map.checked(state, estimator=type(self).__name__)
        MapFilter.restore(self, checked)  # not self.restore: subclasses override it

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that this process has saved, without checks."""
        self.map.restore(state)

    def snapshot(self) -> dict[str, Any]:
        """Return the present state, for :meth:`resume`."""
        return {**with_copies(vars(self)), "map": self.map.snapshot()}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a :meth:`snapshot` of a filter with the same settings."""
        self.map.resume(snapshot["map"])
        vars(self).update(with_copies({**snapshot, "map": self.map}))

    @property
    def steps(self) -> int:
        """Number of steps taken; it changes together with the belief."""
        return self.map.steps

    def report(self) -> UpdateReport:
        """Return the report of the last update once more; empty after an edit."""
        return self.map.last_report()


class EkfSlam(MapFilter):
    """Extended Kalman filter over the robot pose and a growing landmark map.

    The state is (x, y, θ, l1x, l1y, …), with landmarks in the order in which they were
    first seen.  The readings of a scan are linearised together at the predicted state::

        predict   x ← g(x, u),  P ← G P Gᵀ + F R Fᵀ
        update    S = H P Hᵀ + Q = L Lᵀ,  A = L⁻¹ H P
                  x ← x + Aᵀ L⁻¹ ν,  P ← P − Aᵀ A
        new       l = f(x, z),  P_l* = F_p P_p*,  P_ll = F_p P_pp F_pᵀ + F_z Q F_zᵀ

    Parameters
    ----------
    motion_std : array_like, shape (3,)
        (σx, σy, σα) of the motion noise in the robot frame [m, m, rad], per step of
        dt = 1.
    measurement_std : array_like, shape (2,)
        (σβ, σr) of the measurement noise [rad, m], or that of another sensor in its
        units; one number suffices for a sensor that reads one.
    sensor : str or Sensor
        What a reading is: "bearing_range", "position", "bearing", "range", or a
        :class:`~slamgym.estimator.Sensor` of your own; with its noise, where that
        depends on the distance.
    initial_pose : array_like, shape (3,)
        Mean of the first pose (x, y, θ) [m, m, rad].
    initial_pose_std : array_like, shape (3,)
        Its standard deviation; zeros if the first pose defines the map's frame.
    landmark_init : {"full", "independent", "delayed"}
        "full" correlates a new landmark with the pose from which it was seen.
        "independent" omits this correlation, which makes the filter overconfident;
        it serves to reproduce published results.  "delayed" places a landmark once
        readings from several poses determine it, see ``delayed_landmarks``. It
        serves sensors with bearings that are coarse for their ranges, r σβ²/2 > σr.
    gate_probability : float or None
        Readings of mapped landmarks outside this chi-square region of their own
        innovation are rejected; None accepts all.
    noise_at_rest : bool
        False: odometry of exactly (0, 0) adds no motion noise.
    min_range : float
        Readings below this range [m], and those of landmarks expected below it, are
        skipped, because they have no usable bearing.
    motion : str or Motion
        The drive whose odometry `predict` takes, see `find_motion`.

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is not finite, negative or unknown.

    Notes
    -----
    If the heading is uncertain, this filter becomes overconfident, because it treats
    the absolute heading as observable [1]_.

    References
    ----------
    .. [1] S. Julier, J. Uhlmann, A counter example to the theory of simultaneous
       localization and map building, ICRA 2001.

    Examples
    --------
    >>> slam = EkfSlam(motion_std=(0.05, 0.02, 0.01), measurement_std=(0.02, 0.1))
    >>> slam.predict((1.0, 0.0))
    >>> slam.update([(0.0, 2.0)], landmark_ids=[7]).added_ids
    (7,)
    >>> slam.belief().landmarks
    array([[3., 0.]])
    """

    _linearisation: ClassVar[int] = scan.AT_ESTIMATE
    _frame: ClassVar[int] = scan.ADDITIVE

    #: The kernels of both steps.
    update_kernel: ClassVar[UpdateKernel] = staticmethod(update_map)
    move_kernel: ClassVar[Callable[..., None]] = staticmethod(move_pose)
    #: Error messages of further statuses of the update.
    _refusals: ClassVar[Mapping[int, str]] = {}

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        sensor: str | Sensor = "bearing_range",
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        landmark_init: str = "full",
        gate_probability: float | None = None,
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
        motion: str | Motion = UNICYCLE,
    ) -> None:
        self._motion_noise = MotionNoise.checked(motion_std, noise_at_rest, motion)
        given = find_sensor(sensor)
        self.sensor = given.delayed() if landmark_init == DELAYED else given
        self._reads_bearing_range = self.sensor == BEARING_RANGE
        self.rules = checked_rules(
            measurement_std,
            sensor=self.sensor,
            linearisation=self._linearisation,
            frame=self._frame,
            landmark_init=landmark_init,
            gate_probability=gate_probability,
            min_range=min_range,
        )
        self.map = self._empty_map()
        self.reset(initial_pose, initial_pose_std)

    def _empty_map(self) -> GaussianMap:
        """Return a map that the filter's sensor can fill."""
        values = (*self.rules, *self._motion_noise.variance)
        if self.sensor.places:
            return GaussianMap(values)
        from .delayed_landmarks import WaitingMap  # noqa: PLC0415 (few sensors need it)

        return WaitingMap(values, self.sensor)

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading.

        Parameters
        ----------
        odometry : array_like, shape (2,)
            u = (d, α): distance driven, then heading turned [m, rad]; or the
            columns of another drive.
        dt : float
            Duration that the motion noise counts, in steps: its variance grows with
            dt, and dt = 0 adds none.
        """
        noise, weight = self._motion_noise, 1.0
        if noise.motion is UNICYCLE:  # a tenth of a prediction faster
            forward, turn = argument_checks.pair("odometry", odometry)
            sideways = 0.0
        else:
            forward, sideways, turn = noise.motion.moved(odometry)
        if not (type(dt) is float and dt == 1.0 and noise.at_rest):
            weight = noise.weight((forward, sideways, turn), dt)
        self.move_kernel(self.map.block, forward, sideways, turn, weight)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then map the landmarks seen first.

        Parameters
        ----------
        measurements : array_like, shape (m, 2)
            Rows (β, r) [rad, m], or those of the filter's sensor, all seen at once:
            their order does not matter.
        landmark_ids : sequence of int, length m
            Identity of the landmark behind each row, without repetition.

        Returns
        -------
        UpdateReport
            Innovations, NIS, and which landmarks were associated, added, rejected.

        Raises
        ------
        ValueError
            If the arguments are malformed; the belief is then as before.
        numpy.linalg.LinAlgError
            If an innovation covariance is not positive definite, naming the
            reading; the belief is then as before.
        MemoryError
            If memory cannot hold the map; the belief is then as before.
        """
        readings = argument_checks.scan(measurements, self.sensor.columns)
        ids = argument_checks.identity_array(landmark_ids, len(readings), self)
        kernel = (
            self.update_kernel
            if self._reads_bearing_range
            else self._kernel_of_sensor()
        )
        status = self.map.take_in(kernel, readings, ids)
        if status != DONE:
            self._refuse(status, readings, ids)
        return self.map.report()

    def _kernel_of_sensor(self) -> UpdateKernel:
        from ..models.sensor_kernels import for_sensor  # noqa: PLC0415 (compiled anew)

        kernel: UpdateKernel = for_sensor(self.update_kernel, self.sensor)
        return kernel

    @property
    def motion_values(self) -> Array:
        """(σx², σy², σα²) per step, and 1 where a robot at rest has noise too."""
        return np.append(self._motion_noise.variance, self._motion_noise.at_rest)

    @property
    def motion(self) -> Motion:
        """The drive whose odometry `predict` takes."""
        return self._motion_noise.motion

    @property
    def rule_values(self) -> Array:
        """The rules as the kernels take them."""
        return np.array(self.rules)

    def _adopt(self, rules: Rules) -> None:
        """Go on with other rules."""
        self.rules = rules
        self.map.adopt((*rules, *self._motion_noise.variance))

    def _refuse(self, status: int, readings: Array, ids: IntArray) -> NoReturn:
        """Raise the error of an update that failed."""
        given = ids.tolist()
        if status in self._refusals:
            raise ValueError(self._refusals[status])
        if status == REPEATED:
            argument_checks.refuse_repeated(given)
        if status == NOT_USABLE:
            argument_checks.refuse_unusable(readings, given)
        used = self.map.parts.ledger[scan.OUTCOME, : len(ids)] == scan.USED
        raise argument_checks.not_positive_definite(given[np.flatnonzero(used)[status]])


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
        Most linearisations of a scan, with the same prior.  A scan with readings far
        from their predictions is linearised again until no landmark moves by more than
        a tenth of its distance; where the heading turns by more than 0.1 rad, the
        readings are taken one after the other, the farthest landmark first, each until
        it no longer moves.  1 always linearises once, for study.
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

    _frame: ClassVar[int] = scan.INVARIANT

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        iterations: int = 10,
        **settings: Any,
    ) -> None:
        super().__init__(motion_std, measurement_std, **settings)
        most = argument_checks.whole("iterations", iterations, 1)
        self._adopt(self.rules._replace(iterations=most, adaptive=most > 1))


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

    _linearisation: ClassVar[int] = scan.AT_REFERENCE


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

    _linearisation: ClassVar[int] = scan.PROJECTED


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


# --------------------------------------------------------------------------------------
# The settings of a filter, checked and converted to rules for kernels.


def checked_rules(
    measurement_std: ArrayLike,
    *,
    sensor: Sensor,
    linearisation: int = scan.AT_ESTIMATE,
    frame: int = scan.ADDITIVE,
    landmark_init: str = "full",
    gate_probability: float | None = None,
    min_range: float,
) -> Rules:
    """Return the rules of an update, from the arguments of :class:`.ekf.EkfSlam`."""
    std = two_stds(sensor, measurement_std)
    argument_checks.one_of("landmark_init", landmark_init, LANDMARK_INITS)
    return Rules(
        linearisation=linearisation,
        frame=frame,
        correlated=landmark_init != "independent",
        first_std=float(std[0]),
        second_std=float(std[1]) if sensor.size == 2 else 1.0,
        std_per_metre=float(sensor.range_std_per_metre),
        std_metres=float(sensor.bearing_std_metres),
        min_range=argument_checks.positive("min_range", min_range),
        gate=_gate(gate_probability, sensor.size),
        noise_as_read=sensor.range_noise_at == "reading",
        numbers=sensor.size,
    )


def reading_variances(rules: Rules, ranges: Array, sensor: Sensor) -> Array:
    """Return the variances of readings at these ranges [m], shape (m, 2)."""
    std = rules.first_std, rules.second_std
    return sensor.stds(std, np.maximum(ranges, rules.min_range)) ** 2


def _gate(probability: float | None, numbers: int) -> float:
    """Return the χ² quantile of the gate for readings of one or two numbers."""
    if probability is None:
        return inf
    if not (isinstance(probability, float) and 0 < probability < 1):
        raise ValueError(
            f"gate_probability must lie between 0 and 1, got {probability!r}"
        )
    if numbers == 1:
        return NormalDist().inv_cdf((1 + probability) / 2) ** 2
    return -2 * log1p(-probability)  # P(χ²₂ > g) = e^{−g/2}
