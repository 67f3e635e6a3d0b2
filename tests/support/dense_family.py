"""Dense, slow twins of the filter family, written from the equations of their papers.

Each shares the textbook filter's map keeping and nothing with the kernels: explicit
matrices over the whole state, matrix exponentials, complex-step derivatives.
"""

import numpy as np
from dense_ekf import DenseEkf
from scipy.linalg import block_diag, expm, sqrtm

from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.models.motions import predict_pose

J = np.array([[0.0, -1.0], [1.0, 0.0]])


def levers(mean):
    """J q of robot position and landmarks, 0 at the heading."""
    turned = np.zeros(len(mean))
    turned[:2] = J @ mean[:2]
    turned[3:] = (mean[3:].reshape(-1, 2) @ J.T).ravel()
    return turned


class DenseInvariant(DenseEkf):
    """In invariant coordinates throughout: P is the covariance of ξ, G = I."""

    range_std_per_metre = 0.0

    def to_invariant(self):
        """D = I − (J q) e_θᵀ at the mean."""
        D = np.eye(len(self.mean))
        D[:, 2] -= levers(self.mean)
        return D

    @property
    def covariance(self):
        back = np.linalg.inv(self.to_invariant())
        return back @ self.P @ back.T

    def predict(self, odometry, dt=1.0):
        motion = predict_pose(self.mean[:3], np.asarray(odometry, dtype=float))
        self.mean[:3] = motion.pose
        noise = np.zeros((len(self.mean), 3))
        noise[:3] = motion.jacobian_noise
        noise = self.to_invariant() @ noise
        self.P = self.P + noise @ self.R @ noise.T * dt

    def correct(self, readings, ids):
        prior = self.mean.copy()
        total, self.P, nis = self.gain(readings, ids, np.zeros(len(prior)))
        self.mean = self.exponential(total, prior)
        return nis

    def gain(self, readings, ids, total):
        """ξ and P after readings linearised at the mean, Exp(total) from the prior."""
        nu, H = self.linearise(readings, ids)
        H = H.copy()
        H[:, 2] = 0.0  # in ξ the heading moves no reading, at any iterate
        nu = nu + H @ total
        ranges = np.linalg.norm(self.seen(ids), axis=1)
        S = H @ self.P @ H.T + block_diag(*map(self.noise, ranges))
        K = np.linalg.solve(S, H @ self.P).T
        P = (np.eye(len(self.mean)) - K @ H) @ self.P
        return K @ nu, (P + P.T) / 2, float(nu @ np.linalg.solve(S, nu))

    settles = False

    def observe_pose(self, z, H, R):
        """H by ξ at the corrected mean, found by iteration where the filter may."""
        prior, xi, nis = self.mean, np.zeros(len(self.mean)), None
        for _ in range(100 if self.settles else 1):
            self.mean = self.exponential(xi, prior)
            columns = np.zeros((len(H), len(xi)))
            columns[:, :3] = H
            columns = columns @ np.linalg.inv(self.to_invariant())
            S = columns @ self.P @ columns.T + R
            K = np.linalg.solve(S, columns @ self.P).T
            nu = self.off(z, H, self.mean[:3])
            nis = float(nu @ np.linalg.solve(S, nu)) if nis is None else nis
            xi = K @ (nu + columns @ xi)
        self.mean = self.exponential(xi, prior)
        self.P = self.P - K @ S @ K.T
        return nis

    @staticmethod
    def exponential(xi, mean):
        """χ ← Exp(ξ) χ by the matrix exponential of SE_{1+n}(2)."""
        n = (len(mean) - 3) // 2
        algebra = np.zeros((3 + n, 3 + n))
        algebra[:2, :2] = xi[2] * J
        algebra[:2, 2] = xi[:2]
        algebra[:2, 3:] = xi[3:].reshape(-1, 2).T
        group = expm(algebra)
        points = np.concatenate([mean[None, :2], mean[3:].reshape(-1, 2)])
        moved = points @ group[:2, :2].T + group[:2, 2:].T
        return np.concatenate([moved[0], [mean[2] + xi[2]], moved[1:].ravel()])

    def noise(self, distance):
        growth = np.array([0.0, self.range_std_per_metre * distance])[: len(self.Q)]
        return np.diag((np.sqrt(np.diag(self.Q)) + growth) ** 2)

    def seen(self, ids):
        """The landmarks relative to the robot's position."""
        points = self.mean[3:].reshape(-1, 2)[[self.ids.index(i) for i in ids]]
        return points - self.mean[:2]

    def add(self, reading, landmark_id):
        self.P, Q = self.covariance, self.Q
        self.Q = self.noise(reading[1])
        super().add(reading, landmark_id)
        self.Q, D = Q, self.to_invariant()
        self.P = D @ self.P @ D.T


class DenseAdaptiveInvariant(DenseInvariant):
    """Linearised again where a reading is far off; one by one where the heading turns.

    One by one, P becomes that of the corrected belief before the next reading.
    """

    iterations, settles = 10, True

    def correct(self, readings, ids):
        prior, nothing = self.mean.copy(), np.zeros(len(self.mean))
        total, P, nis = self.gain(readings, ids, nothing)
        nu, H = self.linearise(readings, ids)
        ranges = np.linalg.norm(self.seen(ids), axis=1)
        per_metre = np.linalg.norm(H[:, 3:], axis=1)  # a bearing changes by 1 / range
        is_far = (np.abs(nu) > 0.1 * np.repeat(ranges, len(self.Q)) * per_metre).any()
        for i in range(self.iterations):
            before = self.seen(ids)
            self.mean = self.exponential(total, prior)
            if not is_far:
                break
            if abs(total[2]) > 0.1:
                self.mean = prior
                for k in np.argsort(-ranges, kind="stable"):
                    self.correct_alone(readings[[k]], [ids[k]])
                return nis
            if not self.displaced(before, ids) or i == self.iterations - 1:
                break
            total, P, _ = self.gain(readings, ids, total)
        self.P = P
        return nis

    def correct_alone(self, readings, ids):
        prior = self.mean.copy()
        for most in (self.iterations, 1):
            total, nis = np.zeros(len(prior)), []
            self.mean = prior
            for _ in range(most):
                before = self.seen(ids)
                total, P, one = self.gain(readings, ids, total)
                nis.append(one)
                self.mean = self.exponential(total, prior)
                if settled := not self.displaced(before, ids):
                    break
            if settled and nis[-1] <= nis[0] + 13.8:
                break
        self.P = P

    def displaced(self, before, ids):
        moved = np.linalg.norm(self.seen(ids) - before, axis=1)
        return (moved > 0.1 * np.linalg.norm(before, axis=1)).any()


class DenseIterated(DenseEkf):
    """Bell and Cathey: Gauss-Newton on the prior and all readings together."""

    iterations = 3

    def correct(self, readings, ids):
        prior = self.mean.copy()
        Q = np.kron(np.eye(len(ids)), self.Q)
        for i in range(self.iterations):
            nu, H = self.linearise(readings, ids)
            S = H @ self.P @ H.T + Q
            if i == 0:
                nis = float(nu @ np.linalg.solve(S, nu))
            K = np.linalg.solve(S, H @ self.P).T
            self.mean = prior + K @ (nu - H @ (prior - self.mean))
        self.P = (np.eye(len(prior)) - K @ H) @ self.P
        self.P = (self.P + self.P.T) / 2
        return nis


class DenseFirstEstimates(DenseEkf):
    """Jacobians at the predicted pose and the first landmark estimates."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.fixed = self.mean.copy()

    def predict(self, odometry, dt=1.0):
        motion = predict_pose(self.mean[:3], np.asarray(odometry, dtype=float))
        G = np.eye(len(self.mean))
        G[:2, 2] = J @ (motion.pose[:2] - self.fixed[:2])
        self.P = G @ self.P @ G.T
        F = motion.jacobian_noise
        self.P[:3, :3] += F @ self.R @ F.T * dt
        self.mean[:3] = self.fixed[:3] = motion.pose

    def linearise(self, readings, ids):
        nu, _ = super().linearise(readings, ids)
        estimate, self.mean = self.mean, self.fixed
        _, H = super().linearise(readings, ids)
        self.mean = estimate
        return nu, H

    def add(self, reading, landmark_id):
        located = self.locate(reading)
        position, Fz = located.position[0], located.jacobian_measurement[0]
        n = len(self.mean)
        extend = np.zeros((n + 2, n))
        extend[:n] = np.eye(n)
        extend[n:, :2] = np.eye(2)
        extend[n:, 2] = J @ (self.first(position, landmark_id) - self.fixed[:2])
        self.P = extend @ self.P @ extend.T
        self.P[n:, n:] += Fz @ self.Q @ Fz.T
        self.mean = np.concatenate([self.mean, position])
        self.fixed = np.concatenate([self.fixed, self.first(position, landmark_id)])
        self.ids.append(landmark_id)

    def first(self, position, landmark_id):
        return position


class DenseConstrained(DenseFirstEstimates):
    """H at the estimate, projected off the turn of the fixed points."""

    def linearise(self, readings, ids):
        nu, H = DenseEkf.linearise(self, readings, ids)
        for k, i in enumerate(ids):
            c = 3 + 2 * self.ids.index(i)
            own = [0, 1, 2, c, c + 1]
            N = np.zeros((5, 3))  # shifts and turn of robot and landmark together
            N[:2, :2] = N[3:, :2] = np.eye(2)
            N[:2, 2], N[2, 2] = J @ self.fixed[:2], 1.0
            N[3:, 2] = J @ self.fixed[c : c + 2]
            rows = slice(len(self.Q) * k, len(self.Q) * (k + 1))
            off = np.eye(5) - N @ np.linalg.solve(N.T @ N, N.T)
            H[rows, own] = H[rows][:, own] @ off
        return nu, H


class DenseIdeal(DenseFirstEstimates):
    """Jacobians at the ground truth."""

    def observe_truth(self, pose, landmarks):
        if not hasattr(self, "truth"):
            self.fixed[:3] = pose
        self.truth, self.true_landmarks = np.asarray(pose, dtype=float), landmarks

    def predict(self, odometry, dt=1.0):
        motion = predict_pose(self.mean[:3], np.asarray(odometry, dtype=float))
        F = predict_pose(self.fixed[:3], np.zeros(2)).jacobian_noise
        G = np.eye(len(self.mean))
        G[:2, 2] = J @ (self.truth[:2] - self.fixed[:2])
        self.P = G @ self.P @ G.T
        self.P[:3, :3] += F @ self.R @ F.T * dt
        self.mean[:3] = motion.pose
        self.fixed[:3] = self.truth

    def first(self, position, landmark_id):
        return np.asarray(self.true_landmarks[landmark_id], dtype=float)


class DenseUnscented(DenseEkf):
    """Cubature points one by one."""

    gate = np.inf  # largest NIS of one reading by itself

    def points(self, P):
        root = np.real(sqrtm(P)) if P.any() else np.zeros_like(P)
        n = len(P)
        return [s * np.sqrt(n) * root[:, i] for s in (1, -1) for i in range(n)]

    def predict(self, odometry, dt=1.0):
        n = len(self.mean)
        both = np.zeros((n + 3, n + 3))
        both[:n, :n], both[n:, n:] = self.P, self.R * dt
        moved = []
        for offset in self.points(both):
            state, noise = self.mean + offset[:n], offset[n:]
            motion = predict_pose(state[:3], np.asarray(odometry, dtype=float))
            state[:3] = motion.pose + motion.jacobian_noise @ noise
            moved.append(state)
        moved = np.array(moved)
        self.mean = moved.mean(axis=0)
        self.P = (moved - self.mean).T @ (moved - self.mean) / len(moved)

    def correct(self, readings, ids):
        slots = [self.ids.index(i) for i in ids]

        def sense(state):
            landmarks = state[3:].reshape(-1, 2)[slots]
            return self.predict_readings(state[:3], landmarks).measurement

        offsets = np.array(self.points(self.P))
        centre = sense(self.mean)
        seen = np.array([sense(self.mean + offset) for offset in offsets])
        seen = self.difference(seen, centre)[..., : len(self.Q)]
        average, centre = seen.mean(axis=0), centre[:, : len(self.Q)]
        spread = (seen - average).reshape(len(seen), -1)
        expected = np.zeros_like(readings)
        expected[:, : len(self.Q)] = centre + average
        nu = self.difference(readings, expected)[:, : len(self.Q)].ravel()
        S = spread.T @ spread / len(seen) + np.kron(np.eye(len(ids)), self.Q)
        C = offsets.T @ spread / len(seen)
        own = [slice(k, k + len(self.Q)) for k in range(0, len(nu), len(self.Q))]
        alone = [nu[k] @ np.linalg.solve(S[k, k], nu[k]) <= self.gate for k in own]
        self.rejected = tuple(i for i, kept in zip(ids, alone, strict=True) if not kept)
        rows = np.repeat(alone, len(self.Q))
        self.nu, self.S = nu, S = nu[rows], S[np.ix_(rows, rows)]
        C = C[:, rows]
        self.mean = self.mean + C @ np.linalg.solve(S, nu)
        self.P = self.P - C @ np.linalg.solve(S, C.T)
        self.P = (self.P + self.P.T) / 2
        return float(nu @ np.linalg.solve(S, nu))


class DenseRobocentric(DenseEkf):
    """State (way, origin of the world, its heading, landmarks) in the robot's frame."""

    def __init__(self, motion_std, measurement_std, initial_pose_std=(0, 0, 0)):
        super().__init__(motion_std, measurement_std, initial_pose_std)
        start, P = self.mean, self.P
        M = complex_step(rigid_inverse, start)
        self.mean = np.concatenate([np.zeros(3), rigid_inverse(start)])
        self.P = np.zeros((6, 6))
        self.P[3:, 3:] = M @ P @ M.T

    def linearise(self, readings, ids):
        nu, H = self.shifted(super().linearise, readings, ids)
        return nu, np.insert(H, 3, np.zeros((3, 1)), axis=1)

    def shifted(self, function, *args):
        """Call a method of the textbook filter on the state without the world."""
        full = self.mean
        self.mean = np.delete(full, [3, 4, 5])
        result = function(*args)
        self.mean = full
        return result

    def add(self, reading, landmark_id):
        super().add(reading, landmark_id)  # at the end of the state, wherever that is

    def update(self, readings, ids):
        nis = super().update(readings, ids)
        if len(ids):
            M = complex_step(self.moved, self.mean)
            self.mean, self.P = self.moved(self.mean), M @ self.P @ M.T
        return nis

    @staticmethod
    def moved(state):
        way = state[:3]
        back = turn(-way[2])
        points = [back @ (q - way[:2]) for q in state[6:].reshape(-1, 2)]
        origin = back @ (state[3:5] - way[:2])
        return np.concatenate([0 * way, origin, [state[5] - way[2]], *points])

    @staticmethod
    def world(state):
        back = turn(-state[5])
        robot = back @ (state[:2] - state[3:5])
        points = [back @ (q - state[3:5]) for q in state[6:].reshape(-1, 2)]
        return np.concatenate([robot, [state[2] - state[5]], *points])

    def observe_pose(self, z, H, R):
        M = complex_step(self.world, self.mean)[:3]
        return self.condition(self.off(z, H, self.world(self.mean)[:3]), H @ M, R)

    def belief(self):
        M = complex_step(self.world, self.mean)
        return self.world(self.mean), M @ self.P @ M.T


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def rigid_inverse(pose):
    return np.concatenate([-turn(-pose[2]) @ pose[:2], [-pose[2]]])


def complex_step(function, point, step=1e-30):
    """Exact derivative of an analytic function."""
    columns = [
        np.imag(function(point + 1j * step * e)) / step for e in np.eye(len(point))
    ]
    return np.stack(columns, axis=-1)


class DenseTwiceInvariant(DenseAdaptiveInvariant):
    iterations = 2


TWINS = {
    "ekf": DenseEkf,
    "invariant": DenseAdaptiveInvariant,
    "invariant[iterations=1]": DenseInvariant,
    "invariant[iterations=2]": DenseTwiceInvariant,
    "first_estimates": DenseFirstEstimates,
    "observability_constrained": DenseConstrained,
    "iterated": DenseIterated,
    "unscented": DenseUnscented,
    "robocentric": DenseRobocentric,
    "ideal": DenseIdeal,
    "compressed": DenseEkf,
    "compressed[base=invariant]": DenseAdaptiveInvariant,
}
"""The twins of estimators, by label."""


def tell_truth(slam, pose, landmarks):
    """Give the ground truth to a filter that linearises there."""
    if hasattr(slam, "observe_truth"):
        slam.observe_truth(pose, landmarks)


def belief_of(twin):
    """Return mean, the heading wrapped, and covariance."""
    if isinstance(twin, DenseRobocentric):
        mean, covariance = twin.belief()
    else:
        mean, covariance = twin.mean.copy(), getattr(twin, "covariance", twin.P)
    mean[2] = wrap_angle(mean[2])
    return mean, covariance
