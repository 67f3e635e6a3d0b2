"""The ideal EKF-SLAM: Jacobians at the ground truth, for study only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import LandmarkIds
from ...arrays import Array
from ..beliefs import UpdateReport
from ..guards import saved_states
from ..interface import returned_on_error
from ..kernels.scan_update import AT_ESTIMATE, AT_TRUTH, BeliefArrays
from ..models.rigid_motion import composed, pose_rotation
from ..models.sensors import only_bearing_range
from .ekf import EkfSlam


class IdealEkfSlam(EkfSlam):
    """The standard filter with its Jacobians at the ground truth, for study only.

    It shows how much of an inconsistency is caused by the linearisation points [1]_.
    Pass the truth to :meth:`observe_truth` before each predict.  Until its first call,
    the filter linearises at its estimate like ``ekf``.  If the first heading is
    uncertain, the filter is no benchmark: the Jacobians are then in the frame of the
    truth and the innovations in that of the estimate, and the filter diverges.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for
       designing consistent EKF SLAM estimators, IJRR 29(5), 2010.
    """

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run; it linearises at the estimate until the truth is given."""
        only_bearing_range(self.sensor, "the ideal filter")
        with returned_on_error(self):
            super().reset(pose, pose_std)
            self._linearise_at(AT_ESTIMATE)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the state, and whether the truth has been given."""
        told = self.rules.linearisation == AT_TRUTH
        return {**super().state_dict(), "at_truth": np.array(told)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state; the truth of each further step must be given."""
        saved_states.refuse_other_state(state, ["at_truth"])
        at_truth = saved_states.flag("at_truth", state["at_truth"])
        with returned_on_error(self):
            super().load_state_dict(state)
            self._linearise_at(AT_TRUTH if at_truth else AT_ESTIMATE)

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that this process has saved, without checks."""
        super().restore(state)
        self._linearise_at(AT_TRUTH if state["at_truth"] else AT_ESTIMATE)

    def _linearise_at(self, where: int) -> None:
        self._adopt(self.rules._replace(linearisation=where))

    @staticmethod
    def _check_told(ids: Iterable[int], told: Mapping[int, Array]) -> None:
        untold = [i for i in ids if i not in told]
        if untold:
            raise ValueError(
                f"landmarks must hold the truth of all that are seen, got none of "
                f"landmark {untold[0]}"
            )

    def observe_truth(
        self, pose: ArrayLike, landmarks: Mapping[int, ArrayLike]
    ) -> None:
        """Set the truth after a motion, before predict (at the start: before update).

        Parameters
        ----------
        pose : array_like, shape (3,)
            True pose (x, y, θ) after the motion [m, m, rad].
        landmarks : mapping from id to (2,)
            True positions of all landmarks that may be seen [m].
        """
        truth = argument_checks.finite_vector("pose", pose, 3)
        if not isinstance(landmarks, Mapping):
            raise ValueError(
                f"landmarks must map identities to positions, got {landmarks!r}"
            )
        told = {
            i: argument_checks.finite_vector(f"landmarks[{i}]", xy, 2)
            for i, xy in landmarks.items()
        }
        self._check_told(self.map.slots, told)
        mean, covariance, reference = self.map.used
        reference = reference.copy()
        if self.rules.linearisation != AT_TRUTH:
            reference[:3] = truth
        for i, slot in self.map.slots.items():
            reference[3 + 2 * slot : 5 + 2 * slot] = told[i]
        with returned_on_error(self):
            if self.rules.linearisation != AT_TRUTH:
                self._linearise_at(AT_TRUTH)
            self._true_pose, self._true_landmarks = truth, told
            self.map.hold(BeliefArrays(mean, covariance, reference), self.map.slots)

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad]; the covariance follows the true motion."""
        if self.rules.linearisation != AT_TRUTH:
            super().predict(odometry, dt)
            return
        displacement = self.motion.moved(odometry)
        variance = self._motion_noise.over(displacement, dt)
        mean, covariance, reference = (each.copy() for each in self.map.used)
        mean[:3] = composed(mean[0], mean[1], mean[2], *displacement)[:3]
        heading = reference[2]
        dx, dy = self._true_pose[:2] - reference[:2]
        G = np.eye(len(mean))
        G[:2, 2] = -dy, dx
        F = pose_rotation(heading)
        moved = G @ covariance @ G.T
        moved[:3, :3] += F @ np.diag(variance) @ F.T
        reference[:3] = self._true_pose
        belief = BeliefArrays(mean, (moved + moved.T) / 2, reference)
        self.map.hold(belief, self.map.slots, steps=1)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, linearised at the truth."""
        if self.rules.linearisation == AT_TRUTH and landmark_ids is not None:
            readings = argument_checks.scan(measurements)
            ids = argument_checks.identities(landmark_ids, len(readings))
            self.map.make_room(len(readings))
            self._check_told(ids, self._true_landmarks)
            column = self.map.size
            for i, distance in zip(ids, readings[:, 1], strict=False):
                if i not in self.map.slots and distance >= self.rules.min_range:
                    self.map.reference[column : column + 2] = self._true_landmarks[i]
                    column += 2
        return super().update(measurements, landmark_ids)
