"""EKF-SLAM: the standard filter, on the shared kernels."""

from collections.abc import Mapping
from functools import partial
from itertools import compress
from math import isfinite, log1p
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..error_frames import ErrorFrame
from ..interface import Belief, UpdateReport
from ..kernels.belief_arrays import aligned_zeros
from ..kernels.covariance_update import BLOCK
from ..kernels.predict import predict
from ..kernels.rules import ADDITIVE, AT_ESTIMATE, INVARIANT, Rules
from ..kernels.scan_record import record
from ..kernels.scan_rows import (
    ADDED,
    GATED,
    OUTCOME,
    SKIPPED,
    SLOT,
    USED,
    Workspace,
    new_ledger,
    new_workspace,
)
from ..kernels.scan_update import DONE, NOT_USABLE, update_belief
from ..support import argument_checks
from ..support.argument_checks import LandmarkIds
from ..support.memory_limit import covariance_bytes, landmarks_that_fit

Array = NDArray[np.float64]

FRAMES: dict[int, ErrorFrame] = {ADDITIVE: "additive", INVARIANT: "invariant"}


class EkfSlam:
    """Extended Kalman filter over the robot pose and a growing landmark map.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of first sight; the
    readings of one scan are linearised together at the predicted state::

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
        Its standard deviation; zeros when the first pose defines the map's frame.
    landmark_init : {"full", "independent"}
        "full" correlates a new landmark with the pose it was seen from.  "independent"
        drops that correlation, which makes the filter overconfident: it exists to
        reproduce results obtained so.
    range_std_per_metre : float
        Part of σr that grows with the range: σr(r) = σr + k r.
    range_noise_at : {"expected", "reading"}
        Which range that is: the one that the belief expects, or the one read, which
        many filters take although it trusts readings more just when they are short.
        For a new landmark it is always the one read.
    gate_probability : float or None
        Readings of mapped landmarks outside this chi-square region of their own
        innovation are rejected; None accepts all.
    noise_at_rest : bool
        False: odometry of exactly (0, 0) adds no motion noise.
    min_range : float
        Readings closer than this [m], or of landmarks expected closer, are skipped:
        they have no usable bearing.

    Raises
    ------
    ValueError
        Where an argument has the wrong shape or is not finite, negative or unknown.

    Notes
    -----
    Wherever the heading is uncertain this filter comes to believe that it observes
    what it cannot, its absolute heading [1]_.

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
        gate_probability: float | None = None,
        noise_at_rest: bool = True,
        min_range: float = 1e-3,
    ) -> None:
        motion = argument_checks.standard_deviations("motion_std", motion_std, 3)
        sensor = argument_checks.standard_deviations(
            "measurement_std", measurement_std, 2
        )
        self._motion_variance = motion**2
        self._noise_at_rest = argument_checks.flag("noise_at_rest", noise_at_rest)
        self._adopt(
            Rules(
                linearisation=self._linearisation,
                frame=self._frame,
                correlated=argument_checks.one_of(
                    "landmark_init", landmark_init, ("full", "independent")
                )
                == "full",
                bearing_std=float(sensor[0]),
                range_std=float(sensor[1]),
                range_std_per_metre=argument_checks.at_least(
                    "range_std_per_metre", range_std_per_metre, 0.0
                ),
                min_range=argument_checks.above("min_range", min_range, 0.0),
                gate=_gate(gate_probability),
                noise_as_read=argument_checks.one_of(
                    "range_noise_at", range_noise_at, ("expected", "reading")
                )
                == "reading",
            )
        )
        self.reset(initial_pose, initial_pose_std)

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
        self._slots: dict[int, int] = {}
        self._size = 3
        self._allocate(landmarks=8)
        self._mean[:3] = self._reference[:3] = first
        self._covariance[:3, :3] = np.diag(std**2)

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
        variance = self._motion_variance_of(distance, turn, dt)
        predict(
            self._mean,
            self._covariance,
            self._reference,
            self._size,
            distance,
            turn,
            variance,
            self._rules.linearisation,
        )

    def _motion_variance_of(self, distance: float, turn: float, dt: float) -> Array:
        if not (isfinite(dt) and dt >= 0):
            raise ValueError(f"dt must be a finite number >= 0, got {dt!r}")
        if not (self._noise_at_rest or distance or turn):
            return self._motion_variance * 0.0
        return self._motion_variance if dt == 1.0 else self._motion_variance * dt

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
            Where the arguments are malformed; the belief is then as before.
        numpy.linalg.LinAlgError
            Where an innovation covariance is not positive definite, naming the
            reading; the belief is then as before.
        MemoryError
            Where the landmarks would be more than memory holds; the belief is then as
            before.
        """
        readings = argument_checks.scan(measurements)
        count = len(readings)
        ids = self._identities(landmark_ids, count)
        self._make_room(count)
        slots = self._slots
        self._ledger[SLOT, :count] = [slots.get(i, -1) for i in ids]
        status, used, nis = update_belief(
            self._mean,
            self._covariance,
            self._reference,
            self._size,
            readings,
            count,
            self._ledger,
            *self._workspace,
            self._rule_values,
        )
        if status != DONE:
            self._refuse(status, readings, ids)
        return self._report(ids, used, nis)

    def belief(self) -> Belief:
        """Return the belief as a snapshot that later steps leave alone."""
        n = self._size
        return Belief(
            self._mean[:n],
            self._covariance[:n, :n],
            tuple(self._slots),
            FRAMES[self._frame],
        )

    def state_dict(self) -> dict[str, Any]:
        """Return copies of mean, covariance, ids and linearisation points."""
        n = self._size
        return {
            "estimator": np.array(type(self).__name__),
            "mean": self._mean[:n].copy(),
            "covariance": self._covariance[:n, :n].copy(),
            "reference": self._reference[:n].copy(),
            "landmark_ids": np.array(list(self._slots), dtype=np.int64),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit in a filter of the same settings.

        Parameters
        ----------
        state : mapping
            What :meth:`state_dict` returned, also after a trip through ``numpy.savez``.

        Raises
        ------
        ValueError
            Where the state lacks an entry, is of another estimator, or does not fit
            together; the belief is then as before.
        """
        mean, covariance, reference, ids = _checked_state(state, type(self).__name__)
        self._allocate(max(8, len(ids)))
        self._slots = {i: slot for slot, i in enumerate(ids)}
        self._size = len(mean)
        self._mean[: len(mean)] = mean
        self._reference[: len(mean)] = reference
        self._covariance[: len(mean), : len(mean)] = covariance

    def memory_for(self, landmarks: int) -> int:
        """Return what a map of so many landmarks takes at least [bytes]."""
        return self._covariances * covariance_bytes(landmarks)

    @property
    def rules(self) -> Rules:
        """What distinguishes this filter's updates from another's."""
        return self._rules

    @property
    def rule_values(self) -> Array:
        """The rules as the kernels take them."""
        return self._rule_values

    @property
    def motion_values(self) -> Array:
        """(σx², σy², σα²) per step, and 1 where a robot at rest has noise too."""
        return np.append(self._motion_variance, float(self._noise_at_rest))

    @staticmethod
    def capacity_for(landmarks: int) -> int:
        """Length of a mean with room for so many landmarks, as the kernels need it."""
        return (3 + 2 * landmarks) // 4 * 4 + 4

    @property
    def _covariances(self) -> int:
        """How many of the size of P an update fills: P, and copies to go back to."""
        iterated = self._rules.iterations > 1
        return 1 + iterated + (iterated or self._rules.sequential)

    def _adopt(self, rules: Rules) -> None:
        self._rules = rules
        self._rule_values = np.array(rules)
        self._scan_room = 0  # the rules say what a workspace holds

    def _allocate(self, landmarks: int, more: int = 0) -> None:
        """Make room for landmarks, and for more to come as far as memory allows."""
        fitting = landmarks_that_fit(landmarks, landmarks + more, self._covariances)
        capacity = self.capacity_for(fitting)
        self._covariance = aligned_zeros(capacity, capacity)  # it may raise: first
        self._mean = np.zeros(capacity)
        self._reference = np.zeros(capacity)
        self._scan_room = 0

    def _make_room(self, readings: int) -> None:
        """Grow the arrays where a scan could overflow them."""
        n = self._size
        if n + 2 * readings >= len(self._mean):
            mean, covariance, reference = self._mean, self._covariance, self._reference
            self._allocate(len(self._slots) + readings, more=len(self._slots))
            self._mean[:n], self._reference[:n] = mean[:n], reference[:n]
            self._covariance[:n, :n] = covariance[:n, :n]
        if readings >= self._scan_room:
            room = 8 + 2 * readings
            self._workspace = workspace_for(self._rules, room, len(self._mean))
            self._ledger = new_ledger(room)
            self._scan_room = room

    def _identities(self, landmark_ids: LandmarkIds | None, count: int) -> list[int]:
        return argument_checks.given_identities(landmark_ids, count, self)

    def _refuse(self, status: int, readings: Array, ids: list[int]) -> None:
        """Raise the error of an update that did not go through."""
        if status == NOT_USABLE:
            argument_checks.refuse_unusable(readings, ids)
        outcomes = self._ledger[OUTCOME, : len(ids)]
        row = np.flatnonzero(outcomes == USED)[status]
        raise not_positive_definite(ids[row])

    def _report(self, ids: list[int], used: int, nis: float) -> UpdateReport:
        _, outcomes, near, _ = self._ledger[:, : len(ids)].tolist()
        found = record(self._workspace.rows, self._ledger, used, self._rules)
        having: dict[int, tuple[int, ...]] = {USED: tuple(ids)}
        if used < len(ids):
            having = {
                chosen: tuple(compress(ids, [one == chosen for one in outcomes]))
                for chosen in (USED, ADDED, GATED, SKIPPED)
            }
            for i in having[ADDED]:
                self._slots[i] = len(self._slots)
            self._size = 3 + 2 * len(self._slots)
        return UpdateReport(
            nis,
            2 * used,
            having[USED],
            having.get(ADDED, ()),
            having.get(GATED, ()),
            having.get(SKIPPED, ()),
            tuple(compress(ids, near)) if any(near) else (),
            found.innovation,
            partial(found.joint_factor, sequential=self._rules.sequential),
        )


def workspace_for(rules: Rules, readings: int, capacity: int) -> Workspace:
    """Allocate what updates by these rules need, with so many readings at most."""
    repeated = rules.iterations > 1 or rules.sequential
    return new_workspace(
        readings,
        capacity,
        iterated=rules.iterations > 1,
        spoilable=repeated or readings > BLOCK,
    )


def not_positive_definite(landmark_id: int) -> np.linalg.LinAlgError:
    """Make the error of an innovation covariance that cannot be solved."""
    return np.linalg.LinAlgError(
        "the innovation covariance is not positive definite at the reading of "
        f"landmark {landmark_id}: the belief or measurement_std is degenerate"
    )


def _gate(probability: float | None) -> float:
    """χ²(2) quantile of the gate."""
    if probability is None:
        return np.inf
    if not (isinstance(probability, float) and 0 < probability < 1):
        raise ValueError(
            f"gate_probability must lie between 0 and 1, got {probability!r}"
        )
    return -2 * log1p(-probability)  # P(χ²₂ > g) = e^{−g/2}


def _checked_state(
    state: Mapping[str, Any], name: str
) -> tuple[Array, Array, Array, list[int]]:
    entries = ("covariance", "landmark_ids", "mean", "reference")
    argument_checks.refuse_other_state(state, entries, estimator=name)
    saved = np.asarray(state["landmark_ids"])
    ids = argument_checks.identities(saved, saved.size)
    size = 3 + 2 * len(ids)
    mean = argument_checks.finite_vector("state['mean']", state["mean"], size)
    reference = argument_checks.finite_vector(
        "state['reference']", state["reference"], size
    )
    covariance = argument_checks.as_floats("state['covariance']", state["covariance"])
    if covariance.shape != (size, size) or not np.isfinite(covariance).all():
        raise ValueError(
            f"state['covariance'] must be finite with shape ({size}, {size}), "
            f"got shape {covariance.shape}"
        )
    if not np.array_equal(covariance, covariance.T):
        raise ValueError("state['covariance'] must be symmetric")
    return mean, covariance, reference, ids
