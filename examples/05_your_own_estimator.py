"""Write a filter of your own, and check it against the interface.

slamgym accepts any class with the methods of `SlamEstimator`; there is no base class.
This example is a textbook EKF-SLAM with dense matrices. The filter itself is the twenty
lines of ``predict``, ``_correct`` and ``_add``. The other methods start it, save it and
return its belief.

`check_estimator` runs a filter in a small known world and lists what it lacks to run
and where it computes wrong beliefs, like Gymnasium's ``check_env`` for environments. It
returns recommendations. The second class of this example turns before it drives.

Run it::

    python examples/05_your_own_estimator.py

The command line takes such a class by its import path::

    slamgym run six_landmarks --estimator my_filters:TextbookEkf
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slamgym import Belief, UpdateReport, check_estimator
from slamgym.estimator import (
    EstimatorContractError,
    argument_checks,
    locate_landmark,
    predict_measurement,
    predict_pose,
    wrap_angle,
)

Array = NDArray[np.float64]


class TextbookEkf:
    """The textbook EKF-SLAM; x is the state, P its covariance."""

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        self._R = np.diag(np.square(motion_std))
        self._Q = np.diag(np.square(measurement_std))
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start at a pose with an empty map."""
        self._x = np.array(pose, dtype=np.float64)
        self._P = np.diag(np.square(pose_std, dtype=np.float64))
        self._ids: tuple[int, ...] = ()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move: x ← g(x, u),  P ← G P Gᵀ + F R Fᵀ dt."""
        u = argument_checks.finite_vector("odometry", odometry, 2)
        moved = predict_pose(self._x[:3], u)
        G, F = np.eye(len(self._x)), moved.jacobian_noise
        G[:3, :3] = moved.jacobian_pose
        self._x[:3] = moved.pose
        self._P = G @ self._P @ G.T
        self._P[:3, :3] += F @ self._R @ F.T * dt

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Correct with the known landmarks, then add the new ones."""
        z = argument_checks.scan(measurements)
        ids = argument_checks.identities(
            [] if landmark_ids is None else landmark_ids, len(z)
        )
        if not np.isfinite(z).all():
            raise ValueError(f"measurements must be finite, got {z.tolist()}")
        known = {i: row for i, row in zip(ids, z, strict=True) if i in self._ids}
        new = {i: row for i, row in zip(ids, z, strict=True) if i not in self._ids}
        report = self._correct(known) if known else UpdateReport()
        for i, row in new.items():
            self._add(i, row)
        return report.replace(added_ids=tuple(new))

    def _correct(self, readings: dict[int, Array]) -> UpdateReport:
        """Correct: x ← x + K ν,  P ← P − K S Kᵀ,  K = P Hᵀ S⁻¹,  S = H P Hᵀ + Q."""
        slots = [self._ids.index(i) for i in readings]
        landmarks = self._x[3:].reshape(-1, 2)[slots]
        expected = predict_measurement(self._x[:3], landmarks)
        H = np.zeros((2 * len(slots), len(self._x)))
        for k, slot in enumerate(slots):
            H[2 * k : 2 * k + 2, :3] = expected.jacobian_pose[k]
            H[2 * k : 2 * k + 2, 3 + 2 * slot : 5 + 2 * slot] = (
                expected.jacobian_landmark[k]
            )
        innovation = np.stack(list(readings.values())) - expected.measurement
        innovation[:, 0] = wrap_angle(innovation[:, 0])
        nu = innovation.ravel()
        S = H @ self._P @ H.T + np.kron(np.eye(len(slots)), self._Q)
        K = np.linalg.solve(S, H @ self._P).T
        self._x += K @ nu
        self._P -= K @ S @ K.T
        return UpdateReport(
            nis=float(nu @ np.linalg.solve(S, nu)),
            degrees_of_freedom=len(nu),
            associated_ids=tuple(readings),
            innovation=innovation,
            factor=np.linalg.cholesky(S),
        )

    def _add(self, landmark_id: int, reading: Array) -> None:
        """Append l = f(x, z), correlated with the pose from which it was seen."""
        seen = locate_landmark(self._x[:3], reading[None])
        Fp, Fz = seen.jacobian_pose[0], seen.jacobian_measurement[0]
        across = Fp @ self._P[:3]
        own = Fp @ self._P[:3, :3] @ Fp.T + Fz @ self._Q @ Fz.T
        self._x = np.append(self._x, seen.position[0])
        self._P = np.block([[self._P, across.T], [across, own]])
        self._ids = (*self._ids, landmark_id)

    def belief(self) -> Belief:
        """Return a snapshot: a Belief copies its arguments."""
        return Belief(self._x, self._P, self._ids)

    def state_dict(self) -> dict[str, Any]:
        """Copy the whole state."""
        return {"x": self._x.copy(), "P": self._P.copy(), "ids": np.array(self._ids)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a copied state."""
        self._x, self._P = state["x"].copy(), state["P"].copy()
        self._ids = tuple(state["ids"].tolist())


class TurnsFirst(TextbookEkf):
    """The same, with the two halves of a motion in the wrong order."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Turn by α, then drive d."""
        distance, turn = argument_checks.finite_vector("odometry", odometry, 2)
        super().predict((0.0, turn), dt)
        super().predict((distance, 0.0), 0.0)


def main() -> None:
    for estimator in (TextbookEkf, TurnsFirst):
        try:
            check_estimator(estimator)
        except EstimatorContractError as error:
            print(error)
        else:
            print(f"{estimator.__name__} keeps the contract")


if __name__ == "__main__":
    main()
