"""Write a filter of your own, and check it against the interface.

slamgym accepts any class with the methods of `SlamEstimator`; there is no base class.
`TextbookEkf` is an EKF-SLAM in plain numpy with all that is required. `CarefulEkf` adds
what is recommended. `TurnsFirst` is wrong, and `check_estimator` says where.

Run it::

    python examples/05_your_own_estimator.py

The command line takes such a class by its import path::

    slamgym run six_landmarks --estimator my_filters:TextbookEkf
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slamgym import Belief, UpdateReport, argument_checks, check_estimator
from slamgym.estimator import EstimatorContractError, wrap_angle

ORIGIN = (0.0, 0.0, 0.0)


class TextbookEkf:
    """The textbook EKF-SLAM: x is (x, y, θ, l1x, l1y, …), and P its covariance."""

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        initial_pose: ArrayLike = ORIGIN,
        initial_pose_std: ArrayLike = ORIGIN,
    ) -> None:
        self.R = np.diag(np.square(motion_std))  # of (εx, εy, εα) in the robot's frame
        self.Q = np.diag(np.square(measurement_std))  # of (β, r)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start at a pose with an empty map."""
        self.x = np.array(pose, dtype=float)
        self.P = np.diag(np.square(np.array(pose_std, dtype=float)))
        self.ids: list[int] = []

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Drive d, then turn by α: x ← g(x, u),  P ← G P Gᵀ + F R Fᵀ dt."""
        d, alpha = np.asarray(odometry, dtype=float)
        c, s = np.cos(self.x[2]), np.sin(self.x[2])
        G, F = np.eye(len(self.x)), np.eye(len(self.x), 3)
        G[:2, 2] = -d * s, d * c
        F[:2, :2] = (c, -s), (s, c)
        self.x[:3] += d * c, d * s, alpha
        self.P = G @ self.P @ G.T + F @ self.R @ F.T * dt

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Correct with known landmarks, x ← x + K ν, P ← P − K S Kᵀ; add new ones."""
        rows = np.reshape(np.asarray(measurements, dtype=float), (-1, 2))
        ids = () if landmark_ids is None else landmark_ids
        scan = {int(i): z for i, z in zip(ids, rows, strict=True)}
        known = tuple(i for i in scan if i in self.ids)
        new = tuple(i for i in scan if i not in self.ids)
        H, nu = np.zeros((2 * len(known), len(self.x))), np.zeros(2 * len(known))
        for k, i in enumerate(known):
            at, pair = 3 + 2 * self.ids.index(i), slice(2 * k, 2 * k + 2)
            dx, dy = self.x[at : at + 2] - self.x[:2]
            r = np.hypot(dx, dy)
            H[pair, :3] = (dy / r**2, -dx / r**2, -1), (-dx / r, -dy / r, 0)
            H[pair, at : at + 2] = (-dy / r**2, dx / r**2), (dx / r, dy / r)
            nu[pair] = scan[i] - (np.arctan2(dy, dx) - self.x[2], r)
        nu[::2] = wrap_angle(nu[::2])
        S = H @ self.P @ H.T + np.kron(np.eye(len(known)), self.Q)
        K = np.linalg.solve(S, H @ self.P).T
        self.x, self.P = self.x + K @ nu, self.P - K @ S @ K.T
        for i in new:
            self._add(i, *scan[i])
        nis = float(nu @ np.linalg.solve(S, nu))
        return UpdateReport(nis, len(nu), associated_ids=known, added_ids=new)

    def _add(self, landmark: int, beta: float, r: float) -> None:
        """Append l = p + r (cos(θ + β), sin(θ + β)), correlated with the rest."""
        c, s = np.cos(self.x[2] + beta), np.sin(self.x[2] + beta)
        J, B = np.eye(len(self.x) + 2, len(self.x)), np.zeros((len(self.x) + 2, 2))
        J[-2:, :3] = (1, 0, -r * s), (0, 1, r * c)
        B[-2:] = (-r * s, c), (r * c, s)
        self.x = np.append(self.x, self.x[:2] + np.array([r * c, r * s]))
        self.P = J @ self.P @ J.T + B @ self.Q @ B.T
        self.ids.append(landmark)

    def belief(self) -> Belief:
        """Return a snapshot: a Belief copies its arguments."""
        return Belief(self.x, self.P, tuple(self.ids))


class CarefulEkf(TextbookEkf):
    """The same with what is recommended: refusals, and a state that can be saved.

    Landmark management edits the map in this state, by the three names in it.
    """

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Refuse what is not two finite numbers before anything changes."""
        super().predict(argument_checks.finite_vector("odometry", odometry, 2), dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Refuse a malformed scan before anything changes."""
        z = argument_checks.scan(measurements)
        if not np.isfinite(z).all():
            raise ValueError(f"measurements must be finite, got {z.tolist()}")
        ids = () if landmark_ids is None else landmark_ids
        return super().update(z, argument_checks.identities(ids, len(z)))

    def state_dict(self) -> dict[str, Any]:
        """Copy the whole state."""
        ids = np.array(self.ids, dtype=int)
        return {"mean": self.x.copy(), "covariance": self.P.copy(), "landmark_ids": ids}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a copied state."""
        self.x, self.P = state["mean"].copy(), state["covariance"].copy()
        self.ids = state["landmark_ids"].tolist()


class TurnsFirst(TextbookEkf):
    """The same, with the two halves of a motion in the wrong order."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Turn by α, then drive d."""
        distance, turn = np.asarray(odometry)
        super().predict((0.0, turn), dt)
        super().predict((distance, 0.0), 0.0)


def main() -> None:
    for estimator in (TextbookEkf, CarefulEkf, TurnsFirst):
        try:
            recommendations = check_estimator(estimator)
        except EstimatorContractError as error:
            print(error)
        else:
            print(
                f"{estimator.__name__} keeps the contract", *recommendations, sep="\n- "
            )


if __name__ == "__main__":
    main()
