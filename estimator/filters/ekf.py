"""EKF-SLAM: the standard filter, on the shared kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ..kernels.predict import predict
from ..kernels.rules import ADDITIVE, AT_ESTIMATE, Rules
from ..kernels.scan_rows import SLOT
from ..kernels.scan_update import DONE, NOT_USABLE, update_belief
from ..support import argument_checks
from ..support.argument_checks import LandmarkIds
from ..update_report import UpdateReport
from .filter_settings import checked_rules
from .gaussian_map import GaussianMap
from .map_filter import MapFilter
from .motion_noise import MotionNoise
from .scan_report import ScanReport
from .scan_workspace import (
    ScanWorkspace,
    covariances_for,
    not_positive_definite,
)

UpdateKernel = Callable[..., tuple[int, int, float]]


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
        (σβ, σr) of the measurement noise [rad, m].
    initial_pose : array_like, shape (3,)
        Mean of the first pose (x, y, θ) [m, m, rad].
    initial_pose_std : array_like, shape (3,)
        Its standard deviation; zeros if the first pose defines the map's frame.
    landmark_init : {"full", "independent"}
        "full" correlates a new landmark with the pose from which it was seen.
        "independent" omits this correlation, which makes the filter overconfident;
        it serves to reproduce published results.
    range_std_per_metre : float
        Part of σr that grows with the range: σr(r) = σr + k r.
    bearing_std_metres : float
        Part of σβ that shrinks with the range: σβ(r) = σβ + b / r. A sensor that
        reads positions with the noise σ has σβ = 0, σr = b = σ.
    range_noise_at : {"expected", "reading"}
        The range r in these formulas: the expected one, or the measured one.  The
        latter is common, but gives more weight to readings that are too short.  For
        a new landmark, it is always the measured one.
    gate_probability : float or None
        Readings of mapped landmarks outside this chi-square region of their own
        innovation are rejected; None accepts all.
    noise_at_rest : bool
        False: odometry of exactly (0, 0) adds no motion noise.
    min_range : float
        Readings below this range [m], and those of landmarks expected below it, are
        skipped, because they have no usable bearing.

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

    _linearisation: ClassVar[int] = AT_ESTIMATE
    _frame: ClassVar[int] = ADDITIVE

    _update_belief: ClassVar[UpdateKernel] = staticmethod(update_belief)
    """The kernel: screen, correct, add new landmarks."""

    rule_values: Array
    """The rules as the kernels take them."""

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        landmark_init: str = "full",
        range_std_per_metre: float = 0.0,
        range_noise_at: str = "expected",
        bearing_std_metres: float = 0.0,
        gate_probability: float | None = None,
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
    ) -> None:
        self._motion_noise = MotionNoise.checked(motion_std, noise_at_rest)
        self.map = GaussianMap()
        self._adopt(
            checked_rules(
                measurement_std,
                linearisation=self._linearisation,
                frame=self._frame,
                landmark_init=landmark_init,
                range_std_per_metre=range_std_per_metre,
                bearing_std_metres=bearing_std_metres,
                range_noise_at=range_noise_at,
                gate_probability=gate_probability,
                min_range=min_range,
            )
        )
        self.reset(initial_pose, initial_pose_std)

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading.

        Parameters
        ----------
        odometry : array_like, shape (2,)
            u = (d, α): distance driven, then heading turned [m, rad].
        dt : float
            Duration that the motion noise counts, in steps: its variance grows with
            dt, and dt = 0 adds none.
        """
        distance, turn = argument_checks.pair("odometry", odometry)
        variance = self._motion_noise.over(distance, turn, dt)
        where = self.rules.linearisation
        predict(*self.map.arrays, self.map.size, distance, turn, variance, where)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then map the landmarks seen first.

        Parameters
        ----------
        measurements : array_like, shape (m, 2)
            Rows (β, r) [rad, m], all seen at once: their order does not matter.
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
            If the landmarks would be more than memory holds; the belief is then as
            before.
        """
        readings = argument_checks.scan(measurements)
        count = len(readings)
        ids = argument_checks.given_identities(landmark_ids, count, self)
        slots = self.map.slots_of(ids)
        new, size = slots.count(-1), self.map.size
        self._make_room(count, new)
        ledger = self._workspace.ledger
        ledger[SLOT, :count] = slots
        if new:
            self.map.expect(ids, ledger[SLOT, :count])
        status, used, nis = self._update_belief(  # the only change of the belief
            *self.map.arrays,
            size,
            readings,
            count,
            ledger,
            *self._workspace.arrays,
            self.rule_values,
        )
        if status != DONE:
            self._refuse(status, readings, ids)
        left = self._workspace.copies(used, count)
        return ScanReport(nis, ids, left, sequential=self.rules.sequential)

    @property
    def motion_values(self) -> Array:
        """(σx², σy², σα²) per step, and 1 where a robot at rest has noise too."""
        return np.append(*self._motion_noise)

    def _adopt(self, rules: Rules) -> None:
        self.rules = rules
        self.rule_values = np.array(rules)
        self._workspace = ScanWorkspace(rules)
        self.map.copies = covariances_for(rules)

    def _make_room(self, readings: int, new: int) -> None:
        """Grow the arrays where a scan with this many new landmarks overflows them."""
        self.map.make_room(new)
        self._workspace.make_room(readings, self.map.capacity)

    def _refuse(self, status: int, readings: Array, ids: list[int]) -> NoReturn:
        """Raise the error of an update that failed."""
        if status == NOT_USABLE:
            argument_checks.refuse_unusable(readings, ids)
        failed = self._workspace.failed_reading(status, len(ids))
        raise not_positive_definite(ids[failed])
