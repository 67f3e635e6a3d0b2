"""Check how an estimator moves mean and covariance in every call: `step_mistakes`.

If all noise is small, every filter follows the equations of the linear Kalman filter,
whatever its inner coordinates are.  Each call of an irregular drive is compared with
these equations, from the belief before it, so that one mistake does not hide another::

    predict    P' = G P Gᵀ + F R Fᵀ dt
    new l      P_lp = J P,    P_ll = J P Jᵀ + N Q Nᵀ,       J = ∂l/∂p, N = ∂l/∂z
    update     K = P Hᵀ S⁻¹,  S = H P Hᵀ + Q,  P' = P − K S Kᵀ,  x' = x + K ν

A belief that differs is compared with those of frequent mistakes, in the tables
``_MOTION``, ``_ADDITION``, ``_CORRECTION`` and ``_AFTERWARDS``.  The finding names the
mistake that gives the same numbers in all of these calls, or at least in most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from .interface import Belief, UpdateReport
from .models.bearing_range import locate_landmark, predict_measurement, wrap_angle
from .models.motions import predict_pose

_MOTION_STD, _SENSOR_STD = (0.002, 0.001, 0.0015), (0.001, 0.003)
_START = {"initial_pose": (1.0, -2.0, 0.6), "initial_pose_std": (5e-4, 1e-3, 1e-3)}
_LANDMARKS = {
    **{4: (5.0, 1.0), 9: (2.0, -6.0), 31: (-4.5, -5.0)},
    **{2: (-6.0, 2.5), 17: (1.5, 7.0), 8: (8.0, -4.0)},
}
_STEPS = 20
_TOLERANCE = 0.01  # of correlations, and of means in deviations
_PLAUSIBLE = 60.0  # NIS of a scan; above it, a belief went wrong before
_COMPARED = 8  # wrong calls of a method that a mistake must explain

_POSE, _LANDMARK, _READING = ("x", "y", "θ"), ("lx", "ly"), ("β", "r")
_PREDICT, _UPDATE, _NEW = "predict()", "update()", "update() of new landmarks"


class Mistake(NamedTuple):
    """How a method differs from its equation."""

    method: str
    #: The mistake that leads to the same numbers, "" if none is known.
    cause: str
    #: An entry, its right value and the one that came; the steps.
    entry: str

    def __str__(self) -> str:
        return ": ".join(filter(None, self))


class _Gaussian(NamedTuple):
    """A belief after a call."""

    covariance: Array
    mean: Array

    @property
    def std(self) -> Array:
        """The deviations, above 0 also of a mistake whose variances are not."""
        return np.asarray(np.sqrt(np.abs(self.covariance.diagonal())) + 1e-9)

    @property
    def is_symmetric(self) -> bool:
        """Whether the covariance is, up to rounding."""
        P, std = self.covariance, self.std
        return bool(((P - P.T) / np.outer(std, std)).max() < 1e-6)

    def gaps(self, other: _Gaussian) -> tuple[Array, Array]:
        """Return how far another belief is away, in deviations of this one."""
        std = self.std
        moved = other.mean - self.mean
        moved[2] = wrap_angle(float(moved[2]))
        spread = np.abs(other.covariance - self.covariance) / np.outer(std, std)
        return spread, np.abs(moved) / std

    def agrees(self, other: _Gaussian, *, mean_only: bool = False) -> bool:
        spread, moved = self.gaps(other)
        gaps = (moved,) if mean_only else (moved, spread)
        return all(gap.max() < _TOLERANCE for gap in gaps)

    def with_zero(self, rows: slice, columns: slice) -> _Gaussian:
        """Return the belief without the covariances of two different parts."""
        P = self.covariance.copy()
        P[rows, columns] = P[columns, rows] = 0
        return self._replace(covariance=P)


class _Prediction(NamedTuple):
    """A prediction: P' = G P Gᵀ + F R Fᵀ dt."""

    before: _Gaussian
    odometry: Array
    dt: float
    pose: Array
    G: Array
    F: Array
    R: Array  # of the whole step

    @classmethod
    def of(cls, before: _Gaussian, odometry: Array, dt: float) -> _Prediction:
        R = np.diag(np.square(_MOTION_STD)) * dt
        moved = predict_pose(before.mean[:3], odometry)
        return cls(before, odometry, dt, *moved, R)

    def right(self) -> _Gaussian:
        return self.with_products()

    def with_products(
        self, *products: Callable[..., Array], whole: bool = True
    ) -> _Gaussian:
        """Return the result with the products of G P Gᵀ and F R Fᵀ in its order."""
        times: list[Callable[..., Array]] = [*products, *[np.matmul] * 4]
        A = np.eye(len(self.before.mean))
        A[:3, :3] = self.G
        P = self.before.covariance
        after = times[1](times[0](A, P), A.T) if whole else A @ P @ A.T
        if not whole:
            after[:3, :3] = times[1](times[0](self.G, P[:3, :3]), self.G.T)
        after[:3, :3] += times[3](times[2](self.F, self.R), self.F.T)
        return _Gaussian(after, np.append(self.pose, self.before.mean[3:]))

    def driving(self, odometry: ArrayLike, ahead: float = 0.0) -> _Gaussian:
        """Return the result of another motion, along the heading θ + ahead."""
        turned = np.array([0.0, 0.0, ahead])
        start = self.before.mean[:3] + turned
        pose, G, F = predict_pose(start, np.asarray(odometry, dtype=float))
        return self._replace(pose=pose - turned, G=G, F=F).right()

    def mistakes(self) -> Iterator[tuple[str, _Gaussian]]:
        for text, wrong in _MOTION:
            yield text, wrong(self)
        for text, R in _wrong_noises("motion noise", self.R, np.sqrt(self.R * self.dt)):
            yield text, self._replace(R=R).right()
        rows = [f"{name}'" for name in _POSE]
        for text, G in _wrong_entries(self.G, rows, _POSE):
            yield text, self._replace(G=G).right()
        for text, F in _wrong_entries(self.F, rows, ("εx", "εy", "εα")):
            yield text, self._replace(F=F).right()
        yield from _afterwards(self.right())

    def fitted(
        self, got: _Gaussian
    ) -> Iterator[tuple[str, Callable[[Any], _Gaussian]]]:
        """Yield mistakes by a factor, which is fitted to the belief after this call."""
        kept = self._replace(R=0 * self.R).right().covariance
        inner = self.F.T @ (got.covariance - kept)[:3, :3] @ self.F  # F⁻¹ = Fᵀ
        names = ("εx", "εy", "εα")
        yield from _noise_factors(
            "motion noise",
            inner,
            self.R,
            names,
            lambda f, q: q._replace(R=q.R @ f).right(),
        )
        yield from _covariance_changes(self.right(), got)


class _ScanUpdate(NamedTuple):
    """An update: readings of landmarks in the map, then of new ones."""

    before: _Gaussian
    known: Array  # (m, 2) readings
    slots: tuple[int, ...]
    new: Array  # (k, 2) readings
    heading: float  # of the whole drive, not wrapped
    Q: Array
    nu: Array
    Hp: Array
    Hl: Array

    @classmethod
    def of(
        cls,
        before: _Gaussian,
        known: Array,
        slots: Sequence[int],
        new: Array,
        heading: float,
    ) -> _ScanUpdate:
        landmarks = before.mean[3:].reshape(-1, 2)[list(slots)]
        expected, Hp, Hl = predict_measurement(before.mean[:3], landmarks)
        nu = _wrapped(known - expected)
        Q = np.diag(np.square(_SENSOR_STD))
        return cls(before, known, tuple(slots), new, heading, Q, nu, Hp, Hl)

    def right(self) -> _Gaussian:
        return self.extended(self.corrected())

    @property
    def jacobian(self) -> Array:
        H = np.zeros((2 * len(self.slots), len(self.before.mean)))
        H[:, :3] = self.Hp.reshape(-1, 3)
        for k, (slot, each) in enumerate(zip(self.slots, self.Hl, strict=True)):
            H[2 * k : 2 * k + 2, 3 + 2 * slot : 5 + 2 * slot] = each
        return H

    @property
    def innovation_covariance(self) -> Array:
        return self._innovation_covariance(self.jacobian)

    def _innovation_covariance(self, H: Array) -> Array:
        S = np.asarray(H @ self.before.covariance @ H.T)
        S.flat[:: len(S) + 1] += np.tile(self.Q.diagonal(), len(self.slots))
        return S

    @property
    def gain(self) -> Array:
        return np.asarray(
            np.linalg.solve(
                self.innovation_covariance, self.jacobian @ self.before.covariance
            ).T
        )

    @property
    def nis(self) -> float:
        nu = self.nu.ravel()
        return (
            float(nu @ np.linalg.solve(self.innovation_covariance, nu))
            if self.slots
            else 0.0
        )

    def corrected(self, K: Array | None = None) -> _Gaussian:
        """Return x + K ν and P − K S Kᵀ, with the right gain or another one."""
        if not self.slots:
            return self.before
        H, P = self.jacobian, self.before.covariance
        S = self._innovation_covariance(H)
        if K is None:
            K = np.asarray(np.linalg.solve(S, H @ P).T)
        return _Gaussian(P - K @ S @ K.T, self.before.mean + K @ self.nu.ravel())

    def downdated(
        self, K: Array | None = None, times: Any = np.matmul, n: int = 1
    ) -> _Gaussian:
        """Return x + K ν and (I − K H)ⁿ P, symmetric or not."""
        K = self.gain if K is None else K
        P, I_KH = (
            self.before.covariance,
            np.eye(len(self.before.mean)) - K @ self.jacobian,
        )
        for _ in range(n):
            P = times(I_KH, P)
        return _Gaussian(P, self.before.mean + K @ self.nu.ravel())

    def of_readings(self, rows: Sequence[int]) -> _ScanUpdate:
        """Return the scan with some of its readings of known landmarks."""
        slots = tuple(self.slots[k] for k in rows)
        arrays = (self.known, self.nu, self.Hp, self.Hl)
        known, nu, Hp, Hl = (array[list(rows)] for array in arrays)
        return self._replace(known=known, slots=slots, nu=nu, Hp=Hp, Hl=Hl)

    def expecting(self, bearing: Callable[[Array, float], Array]) -> _Gaussian:
        """Return the result with expected bearings as a function of (l − p) and θ."""
        x = self.before.mean
        offsets = x[3:].reshape(-1, 2)[list(self.slots)] - x[:2]
        nu = self.nu.copy()
        with np.errstate(divide="ignore"):
            nu[:, 0] = self.known[:, 0] - bearing(offsets.T, x[2])
        return self._replace(nu=nu).corrected()

    def extended(self, g: _Gaussian, **parts: Any) -> _Gaussian:
        """Append the new landmarks to a belief; parts replace J, N, Q, z or pose."""
        if not len(self.new):
            return g
        z = parts.get("z", self.new)
        position, J, N = locate_landmark(g.mean[:3] * parts.get("weight", 1), z)
        J, N = parts.get("J", lambda J: J)(J), parts.get("N", lambda N: N)(N)
        n, A = len(g.mean), np.eye(len(g.mean) + position.size, len(g.mean))
        A[n:, :3] = J.reshape(-1, 3)
        after = A @ g.covariance @ A.T
        for k, each in enumerate(N):
            own = slice(n + 2 * k, n + 2 * k + 2)
            after[own, own] += each @ parts.get("Q", self.Q) @ each.T
        return _Gaussian(after, np.append(g.mean, position))

    def without(self, *, pose: bool = False, others: bool = False) -> _Gaussian:
        """Return the result without covariances of the new landmarks."""
        right, n = self.right(), len(self.before.mean)
        for k in range(len(self.new)):
            own = slice(n + 2 * k, n + 2 * k + 2)
            right = right.with_zero(own, slice(3)) if pose else right
            for rest in (slice(3, own.start), slice(own.stop, None)) if others else ():
                right = right.with_zero(own, rest)
        return right

    def fixed(self, variance: float) -> _Gaussian:
        """Return the result with uncorrelated new landmarks of one variance."""
        right, n = self.without(pose=True, others=True), len(self.before.mean)
        if not len(self.new):
            return right
        right.covariance[n:, n:] = variance * np.eye(2 * len(self.new))
        return right

    def mistakes(self) -> Iterator[tuple[str, _Gaussian]]:
        for text, wrong in _CORRECTION if self.slots else ():
            yield text, self.extended(wrong(self))
        for text, wrong in _ADDITION if len(self.new) else ():
            yield text, wrong(self)
        yield from self._wrong_readings()
        yield from _afterwards(self.right())

    def _wrong_readings(self) -> Iterator[tuple[str, _Gaussian]]:
        """Yield mistakes of the noise, and single entries of the Jacobians."""
        if not len(self.new):
            for text, Q in _wrong_noises("sensor noise", self.Q, np.sqrt(self.Q)):
                yield text, self._replace(Q=Q).right()
            for text, Hp in _wrong_entries(self.Hp, _READING, _POSE):
                yield text, self._replace(Hp=Hp).right()
            for text, Hl in _wrong_entries(self.Hl, _READING, _LANDMARK):
                yield text, self._replace(Hl=Hl).right()
        else:
            g = self.corrected()
            _, J, N = locate_landmark(g.mean[:3], self.new)
            for text, Q in _wrong_noises("sensor noise", self.Q, np.sqrt(self.Q)):
                yield text, self.extended(g, Q=Q)
            for text, entries in _wrong_entries(J, _LANDMARK, _POSE):
                yield text, self.extended(g, J=lambda _, entries=entries: entries)
            for text, entries in _wrong_entries(N, _LANDMARK, _READING):
                yield text, self.extended(g, N=lambda _, entries=entries: entries)

    def fitted(
        self, got: _Gaussian
    ) -> Iterator[tuple[str, Callable[[Any], _Gaussian]]]:
        """Yield mistakes by a factor, which is fitted to the belief after this call."""
        yield from _covariance_changes(self.right(), got)
        if not (self.slots or len(self.new)):
            return
        if len(self.new):
            g, n = self.corrected(), len(self.before.mean)
            kept = self.extended(g, Q=0 * self.Q).covariance
            own = slice(n, n + 2)
            N = locate_landmark(g.mean[:3], self.new)[2][0]
            fixed = float(got.covariance[n, n])
            yield (
                f"new landmarks get the fixed variance {fixed:.3g}, and no covariance",
                lambda q: q.fixed(fixed),
            )
            inner = np.linalg.solve(
                N, np.linalg.solve(N, (got.covariance - kept)[own, own]).T
            )
        else:  # P'⁻¹ = P⁻¹ + Hᵀ Q⁻¹ H
            gained = np.linalg.inv(got.covariance) - np.linalg.inv(
                self.before.covariance
            )
            own = slice(3 + 2 * self.slots[0], 5 + 2 * self.slots[0])
            N = np.linalg.inv(self.Hl[0])
            inner = np.linalg.inv(N.T @ gained[own, own] @ N)
        noise = "sensor noise", inner, self.Q, _READING
        yield from _noise_factors(*noise, lambda f, q: q._replace(Q=q.Q @ f).right())
        if len(self.new):
            yield from _noise_factors(*noise, _with_noise_of_new)


def _with_noise_of_new(factors: Array, call: _ScanUpdate) -> _Gaussian:
    """Return the result with another noise of the readings of new landmarks.

    Of all readings in a scan without new ones.
    """
    Q = call.Q @ factors
    if len(call.new):
        return call.extended(call.corrected(), Q=Q)
    return call._replace(Q=Q).right()


def _wrapped(nu: Array) -> Array:
    return np.column_stack([wrap_angle(nu[:, 0]), nu[:, 1]])


_times, _matmul = np.multiply, np.matmul
_ELEMENTWISE = "is an elementwise product (*), which must be a matrix product (@)"
_NOT_WRAPPED = "the innovation of the bearing is not wrapped to [-π, π)"
_FIRST = "it turns before it moves, and must drive d along the old heading, then turn"

_MOTION: Sequence[tuple[str, Callable[[_Prediction], _Gaussian]]] = (
    ("the call changes nothing", lambda q: q.before),
    ("the odometry is lost, as if d = α = 0", lambda q: q.driving((0.0, 0.0))),
    ("the mean does not move", lambda q: q.right()._replace(mean=q.before.mean)),
    (
        "the covariance is not predicted",
        lambda q: q.right()._replace(covariance=q.before.covariance),
    ),
    (
        "it drives forward where d < 0",
        lambda q: q.driving((abs(q.odometry[0]), q.odometry[1])),
    ),
    (
        "it does not drive where d < 0",
        lambda q: q.driving((max(q.odometry[0], 0), q.odometry[1])),
    ),
    ("d has the wrong sign", lambda q: q.driving((-q.odometry[0], q.odometry[1]))),
    (
        "the turn α has the wrong sign",
        lambda q: q.driving((q.odometry[0], -q.odometry[1])),
    ),
    (
        "it turns left where α < 0",
        lambda q: q.driving((q.odometry[0], abs(q.odometry[1]))),
    ),
    ("the turn α is not added", lambda q: q.driving((q.odometry[0], 0.0))),
    ("the odometry is multiplied by dt", lambda q: q.driving(q.odometry * q.dt)),
    ("d and α are exchanged", lambda q: q.driving(q.odometry[::-1])),
    (_FIRST, lambda q: q.driving(q.odometry, ahead=q.odometry[1])),
    (
        "it drives along θ + α/2, and must drive d along the old heading, then turn",
        lambda q: q.driving(q.odometry, ahead=q.odometry[1] / 2),
    ),
    (
        "the sine of the heading has the wrong sign",
        lambda q: q.driving(q.odometry, ahead=-2 * q.before.mean[2]),
    ),
    (
        "sine and cosine of the heading are exchanged",
        lambda q: q.driving(q.odometry, ahead=np.pi / 2 - 2 * q.before.mean[2]),
    ),
    ("∂x'/∂θ and ∂y'/∂θ are missing", lambda q: q._replace(G=np.eye(3)).right()),
    (
        "∂x'/∂θ and ∂y'/∂θ have the wrong sign",
        lambda q: q._replace(G=2 * np.eye(3) - q.G).right(),
    ),
    ("G is transposed, P' = Gᵀ P G", lambda q: q._replace(G=q.G.T).right()),
    (
        "the Jacobian G is that of the new heading",
        lambda q: q._replace(G=predict_pose(q.pose, q.odometry).jacobian_pose).right(),
    ),
    ("Gᵀ is missing, P' = G P", lambda q: q.with_products(_matmul, lambda a, _: a)),
    *(
        (
            f"G P Gᵀ {_ELEMENTWISE}",
            lambda q, p=pair, w=whole: q.with_products(*p, whole=w),
        )
        for whole in (True, False)
        for pair in ((_times, _times), (_matmul, _times), (_times, _matmul))
    ),
    *(
        (
            f"F R Fᵀ {_ELEMENTWISE}",
            lambda q, p=pair: q.with_products(_matmul, _matmul, *p),
        )
        for pair in ((_times, _times), (_matmul, _times), (_times, _matmul))
    ),
    (
        "F is transposed, the motion noise is rotated by −θ",
        lambda q: q._replace(F=q.F.T).right(),
    ),
    (
        "the motion noise is not rotated by the heading",
        lambda q: q._replace(F=np.eye(3)).right(),
    ),
    (
        "the motion noise is rotated by the new heading",
        lambda q: q._replace(F=predict_pose(q.pose, q.odometry).jacobian_noise).right(),
    ),
    (
        "the variance of the motion noise is not multiplied by dt",
        lambda q: q._replace(R=q.R / q.dt).right(),
    ),
    (
        "the variance of the motion noise is multiplied by dt²",
        lambda q: q._replace(R=q.R * q.dt).right(),
    ),
    (
        "the variance of the motion noise is multiplied by √dt",
        lambda q: q._replace(R=q.R / np.sqrt(q.dt)).right(),
    ),
    (
        "the variance of the motion noise is divided by dt",
        lambda q: q._replace(R=q.R / q.dt**2).right(),
    ),
    (
        "the motion noise is multiplied by |d|",
        lambda q: q._replace(R=q.R * abs(q.odometry[0])).right(),
    ),
    (
        "the motion noise is multiplied by d²",
        lambda q: q._replace(R=q.R * q.odometry[0] ** 2).right(),
    ),
    (
        "the motion noise is missing where d = 0",
        lambda q: q._replace(R=q.R * (q.odometry[0] != 0)).right(),
    ),
    (
        "the covariance of pose and landmarks is not multiplied by G",
        lambda q: _Gaussian(
            _joined(q.right().covariance, q.before.covariance), q.right().mean
        ),
    ),
)

_ADDITION: Sequence[tuple[str, Callable[[_ScanUpdate], _Gaussian]]] = (
    (
        "the position of the robot is not added",
        lambda q: q.extended(q.corrected(), weight=(0, 0, 1)),
    ),
    (
        "the heading is not added to the bearing",
        lambda q: q.extended(q.corrected(), weight=(1, 1, 0)),
    ),
    (
        "the heading is subtracted from the bearing",
        lambda q: q.extended(q.corrected(), weight=(1, 1, -1)),
    ),
    (
        "the bearing has the wrong sign",
        lambda q: q.extended(q.corrected(), z=q.new * (-1, 1)),
    ),
    (
        "bearing and range are exchanged",
        lambda q: q.extended(q.corrected(), z=q.new[:, ::-1]),
    ),
    (
        "sine and cosine are exchanged",
        lambda q: q.extended(
            q.corrected(),
            z=np.column_stack(
                [np.pi / 2 - 2 * q.corrected().mean[2] - q.new[:, 0], q.new[:, 1]]
            ),
        ),
    ),
    (
        "all covariances with the pose and other landmarks are missing",
        lambda q: q.without(pose=True, others=True),
    ),
    ("the covariance with the pose is missing", lambda q: q.without(pose=True)),
    (
        "the covariance of two new landmarks is missing",
        lambda q: q.without(others=True),
    ),
    (
        "the uncertainty of the pose is left out",
        lambda q: q.extended(q.corrected(), J=lambda J: 0 * J),
    ),
    (
        "the uncertainty of the heading is left out",
        lambda q: q.extended(q.corrected(), J=lambda J: J * (1, 1, 0)),
    ),
    (
        "the uncertainty of the position is left out",
        lambda q: q.extended(q.corrected(), J=lambda J: J * (0, 0, 1)),
    ),
    (
        "∂l/∂z is transposed",
        lambda q: q.extended(q.corrected(), N=lambda N: N.swapaxes(1, 2)),
    ),
    (
        "∂l/∂z is not multiplied by the range",
        lambda q: q.extended(
            q.corrected(),
            N=lambda N: N / np.array([[r, 1] for r in q.new[:, 1]])[:, None],
        ),
    ),
    (
        "∂l/∂z is missing, P_ll = J P Jᵀ + Q",
        lambda q: q.extended(q.corrected(), N=lambda N: N * 0 + np.eye(2)),
    ),
    (
        "∂l/∂z is missing, P_ll = J P Jᵀ + diag(σr², σβ²)",
        lambda q: q.extended(q.corrected(), N=lambda N: N * 0 + np.eye(2)[::-1]),
    ),
    ("every reading is used twice", lambda q: q.extended(q.corrected(), Q=q.Q / 2)),
)

_CORRECTION: Sequence[tuple[str, Callable[[_ScanUpdate], _Gaussian]]] = (
    ("the call changes nothing", lambda q: q.before),
    (
        "the covariance is not updated",
        lambda q: q.corrected()._replace(covariance=q.before.covariance),
    ),
    ("the mean is not updated", lambda q: q.corrected()._replace(mean=q.before.mean)),
    (
        "arctan in place of arctan2",
        lambda q: q.expecting(
            lambda o, t: (
                q.known[:, 0] - wrap_angle(q.known[:, 0] - np.arctan(o[1] / o[0]) + t)
            )
        ),
    ),
    (
        "the arguments of arctan2 are exchanged",
        lambda q: q.expecting(
            lambda o, t: q.known[:, 0] - wrap_angle(q.known[:, 0] - np.arctan2(*o) + t)
        ),
    ),
    (_NOT_WRAPPED, lambda q: q.expecting(lambda o, t: np.arctan2(o[1], o[0]) - t)),
    (
        _NOT_WRAPPED,
        lambda q: q.expecting(lambda o, _: np.arctan2(o[1], o[0]) - q.heading),
    ),
    (
        _NOT_WRAPPED,
        lambda q: q.expecting(lambda o, t: wrap_angle(np.arctan2(o[1], o[0]) - t)),
    ),
    (
        "the heading is not subtracted from the expected bearing",
        lambda q: q._replace(nu=_wrapped(q.nu - (q.before.mean[2], 0))).corrected(),
    ),
    (
        "the heading is added to the expected bearing",
        lambda q: q._replace(nu=_wrapped(q.nu - (2 * q.before.mean[2], 0))).corrected(),
    ),
    ("the innovation has the wrong sign", lambda q: q._replace(nu=-q.nu).corrected()),
    (
        "the innovation of the bearing is not used",
        lambda q: q._replace(nu=q.nu * (0, 1)).corrected(),
    ),
    (
        "the innovation of the range is not used",
        lambda q: q._replace(nu=q.nu * (1, 0)).corrected(),
    ),
    (
        "only the first reading of a scan is used",
        lambda q: q.of_readings([0]).corrected(),
    ),
    (
        "only the last reading of a scan is used",
        lambda q: q.of_readings([len(q.slots) - 1]).corrected(),
    ),
    (
        "the first reading of a scan is not used",
        lambda q: q.of_readings(range(1, len(q.slots))).corrected(),
    ),
    (
        "the last reading of a scan is not used",
        lambda q: q.of_readings(range(len(q.slots) - 1)).corrected(),
    ),
    (
        "readings are assigned in the order of the map, and not by landmark_ids",
        lambda q: _ScanUpdate.of(
            q.before, q.known, sorted(q.slots), q.new, q.heading
        ).corrected(),
    ),
    ("every reading is used twice", lambda q: q._replace(Q=q.Q / 2).corrected()),
    (
        "the covariance of pose and landmarks is not used",
        lambda q: q._replace(
            before=q.before.with_zero(slice(3), slice(3, None))
        ).corrected(),
    ),
    *(
        (
            f"the gain of the {text} is missing",
            lambda q, rows=rows, form=form: form(
                q,
                q.gain
                * ~np.isin(np.arange(len(q.gain)), np.arange(len(q.gain))[rows])[
                    :, None
                ],
            ),
        )
        for text, rows in (
            ("pose", slice(3)),
            ("heading", slice(2, 3)),
            ("landmarks", slice(3, None)),
        )
        for form in (_ScanUpdate.corrected, _ScanUpdate.downdated)
    ),
    *(
        (
            "landmarks that are not in the scan are not corrected",
            lambda q, form=form: form(
                q,
                q.gain
                * (q.jacobian.any(axis=0) | (np.arange(len(q.gain)) < 3))[:, None],
            ),
        )
        for form in (_ScanUpdate.corrected, _ScanUpdate.downdated)
    ),
    *(
        (
            "only the diagonal of S is inverted",
            lambda q, form=form: form(
                q,
                q.before.covariance @ q.jacobian.T / q.innovation_covariance.diagonal(),
            ),
        )
        for form in (_ScanUpdate.corrected, _ScanUpdate.downdated)
    ),
    *(
        (
            f"the gain is that of {text}",
            lambda q, f=factor, form=form: form(q, q._replace(Q=q.Q * f).gain),
        )
        for text, factor in (
            ("half the sensor noise", 0.5),
            ("twice the sensor noise", 2),
            ("no sensor noise", 0),
        )
        for form in (_ScanUpdate.corrected, _ScanUpdate.downdated)
    ),
    (
        "(I − K H) is multiplied twice, or (I − K H) P (I − K H)ᵀ lacks K Q Kᵀ",
        lambda q: q.downdated(n=2),
    ),
    (
        "P' lacks (I − K H) P = P − K H P: it is P − K H",
        lambda q: q.corrected()._replace(
            covariance=q.before.covariance - q.gain @ q.jacobian
        ),
    ),
    (f"(I − K H) P {_ELEMENTWISE}", lambda q: q.downdated(times=np.multiply)),
    (
        "K S Kᵀ is added, and must be subtracted",
        lambda q: q.corrected()._replace(
            covariance=2 * q.before.covariance - q.corrected().covariance
        ),
    ),
    (
        "P' = P − K Kᵀ lacks S",
        lambda q: q.corrected()._replace(
            covariance=q.before.covariance - q.gain @ q.gain.T
        ),
    ),
    (
        "only the variances of pose and landmarks are updated",
        lambda q: q.corrected()._replace(
            covariance=_joined(q.corrected().covariance, q.before.covariance)
        ),
    ),
)

_AFTERWARDS: Sequence[tuple[str, Callable[[_Gaussian], _Gaussian]]] = (
    (
        "the covariance of pose and landmarks is set to zero",
        lambda g: g.with_zero(slice(3), slice(3, None)),
    ),
    (
        "the covariance of different landmarks is set to zero",
        lambda g: g._replace(covariance=g.covariance * _blocks(len(g.mean), pose=True)),
    ),
    (
        "all covariances of pose and landmarks with each other are set to zero",
        lambda g: g._replace(covariance=g.covariance * _blocks(len(g.mean))),
    ),
    (
        "only the variances are kept, all covariances are set to zero",
        lambda g: g._replace(covariance=np.diag(g.covariance.diagonal())),
    ),
    *(
        (
            f"correlations are rounded to {k} decimals",
            lambda g, k=k: g._replace(
                covariance=_rounded_correlations(g.covariance, k)
            ),
        )
        for k in (0, 1)
    ),
    *(
        (
            f"the covariance is rounded to {k} decimals",
            lambda g, k=k: g._replace(covariance=g.covariance.round(k)),
        )
        for k in (2, 3, 4, 5, 6)
    ),
    *(
        (
            f"the mean is rounded to {k} decimals",
            lambda g, k=k: g._replace(mean=g.mean.round(k)),
        )
        for k in (0, 1, 2, 3)
    ),
)


def _joined(within: Array, across: Array) -> Array:
    """Join covariances within pose and map, and those across, from two matrices."""
    P = within.copy()
    P[:3, 3:], P[3:, :3] = across[:3, 3:], across[3:, :3]
    return P


def _blocks(n: int, *, pose: bool = False) -> Array:
    """Return 1 within the pose and within each landmark, and across the pose."""
    part = np.repeat(np.arange(1 + (n - 3) // 2), [3] + [2] * ((n - 3) // 2))
    same = part[:, None] == part
    return np.asarray(same | pose & ((part[:, None] == 0) | (part == 0)), dtype=float)


def _rounded_correlations(P: Array, decimals: int) -> Array:
    std = np.sqrt(P.diagonal())
    return np.asarray((P / np.outer(std, std)).round(decimals) * np.outer(std, std))


def _afterwards(right: _Gaussian) -> Iterator[tuple[str, _Gaussian]]:
    for text, wrong in _AFTERWARDS:
        yield text, wrong(right)


def _wrong_entries(
    jacobian: Array, rows: Sequence[str], columns: Sequence[str]
) -> Iterator[tuple[str, Array]]:
    """Yield Jacobians, (…, rows, columns), with a wrong or missing entry."""
    for (i, row), (j, column) in product(enumerate(rows), enumerate(columns)):
        for factor, text in ((-1, "has the wrong sign"), (0, "is missing")):
            wrong = jacobian.copy()
            wrong[..., i, j] *= factor
            yield f"∂{row}/∂{column} {text}", wrong


def _wrong_noises(what: str, noise: Array, std: Array) -> Iterator[tuple[str, Array]]:
    """Yield mistakes of a noise, from its variances and its standard deviations."""
    yield f"the {what} is missing", 0 * noise
    yield f"standard deviations of the {what} are used as variances", std
    yield f"variances of the {what} are squared again", noise**2
    variances = noise.diagonal()
    orders = {tuple(np.roll(variances[::way], k)) for way in (1, -1) for k in range(3)}
    for order in sorted(orders - {tuple(variances)}):
        yield f"standard deviations of the {what} are in another order", np.diag(order)


def _noise_factors(
    what: str,
    inner: Array,
    noise: Array,
    names: Sequence[str],
    wrong: Callable[[Array, Any], _Gaussian],
) -> Iterator[tuple[str, Callable[[Any], _Gaussian]]]:
    """Yield the mistakes of a noise that counts too often, as a whole or in a part."""
    ratios = inner.diagonal() / noise.diagonal()
    everywhere = np.ones(len(names))
    candidates = [(f"the {what}", float(ratios.mean()) * everywhere)]
    for j, name in enumerate(names):
        one = everywhere.copy()
        one[j] = ratios[j]
        candidates += [(f"the {what} in {name}", one)]
    for text, factors in candidates:
        factor = factors[np.abs(factors - 1).argmax()]
        if factor > -_TOLERANCE:
            times = partial(wrong, np.diag(factors))
            yield f"the variance of {text} is multiplied by {factor:.3g}", times


def _covariance_changes(
    right: _Gaussian, got: _Gaussian
) -> Iterator[tuple[str, Callable[[Any], _Gaussian]]]:
    """Yield the mistakes of a covariance that is too large or small as a whole."""
    came, wanted = got.covariance.diagonal(), right.covariance.diagonal()
    factor, more = float(np.median(came / wanted)), float(np.median(came - wanted))
    yield (
        f"the covariance is multiplied by {factor:.3g}",
        lambda q: q.right()._replace(covariance=factor * q.right().covariance),
    )
    yield (
        f"{more:.3g} is added to every variance",
        lambda q: q.right()._replace(
            covariance=q.right().covariance + more * np.eye(len(q.right().mean))
        ),
    )


class _Made(NamedTuple):
    """A call of the drive, and the belief after it."""

    step: int
    call: _Prediction | _ScanUpdate
    got: _Gaussian
    report: UpdateReport | None
    ids: tuple[int, ...]

    @property
    def used(self) -> bool:
        """Whether the call is not an empty scan."""
        call = self.call
        return isinstance(call, _Prediction) or bool(call.slots or len(call.new))

    def wrong_part(self) -> str | None:
        """Return the wrong method, "" if none is, None if the call cannot be judged."""
        try:
            right = self.call.right()
        except np.linalg.LinAlgError:
            return None
        if right.agrees(self.got):
            return ""
        if not _is_proper(self.call.before):
            return None
        if isinstance(self.call, _Prediction):
            return _PREDICT
        if self.call.nis > _PLAUSIBLE:
            return None
        n = len(self.call.before.mean)
        spread, moved = right.gaps(self.got)
        is_old = max(spread[:n, :n].max(), moved[:n].max()) > _TOLERANCE
        is_known = self.call.slots and (is_old or not len(self.call.new))
        return _UPDATE if is_known else _NEW


def step_mistakes(make: Callable[[Mapping[str, Any]], Any]) -> Iterator[Mistake]:
    """Yield how each method differs from its equation, if it does.

    Parameters
    ----------
    make : callable
        Makes a `SlamEstimator` from the keywords of its constructor.
    """
    made, failure = list[_Made](), None
    try:
        for each in _drive(make):
            made.append(each)
    except Exception as error:
        failure = error
    parts = [each.wrong_part() for each in made]
    for method in (_PREDICT, _NEW, _UPDATE):
        wrong = [each for each, part in zip(made, parts, strict=True) if part == method]
        fine = [each for each, part in zip(made, parts, strict=True) if part == ""]
        if wrong:
            yield _named(method, wrong, fine)
    if _UPDATE not in parts:
        yield from _wrong_nis(made)
    if not any(parts):
        yield from _asymmetric(made)
        yield from _rounded(made)
    if failure:
        raise failure


def _drive(make: Callable[[Mapping[str, Any]], Any]) -> Iterator[_Made]:
    """Yield the calls of a drive, which turns to both sides and goes back at times."""
    slam = make({"motion_std": _MOTION_STD, "measurement_std": _SENSOR_STD, **_START})
    truth, seen = np.array(_START["initial_pose"]), list[int]()
    before = _state(slam.belief(), seen)
    for step, odometry, dt, ids, errors in _plan():
        slam.predict(odometry, dt)
        truth = predict_pose(truth, odometry).pose
        got = _state(slam.belief(), seen)
        if got is None or before is None:
            return
        yield _Made(step, _Prediction.of(before, odometry, dt), got, None, tuple(seen))
        landmarks = np.array([_LANDMARKS[i] for i in ids]).reshape(-1, 2)
        readings = predict_measurement(truth, landmarks).measurement + errors
        known, new = [i for i in ids if i in seen], [i for i in ids if i not in seen]
        rows = [readings[[ids.index(i) for i in part]] for part in (known, new)]
        slots = [seen.index(i) for i in known]
        report = slam.update(readings, ids)
        seen += new
        before, after = _state(slam.belief(), seen), got
        if before is None:
            return
        call = _ScanUpdate.of(after, rows[0], slots, rows[1], float(truth[2]))
        yield _Made(step, call, before, report, tuple(seen))


def _plan() -> Iterator[tuple[int, Array, float, list[int], Array]]:
    """Yield step, odometry, dt, ids of the scan, and errors of its readings."""
    rng, ids = np.random.default_rng(5), list(_LANDMARKS)
    yield 1, np.array([1.5, 0.7]), 3.0, ids[:2], np.zeros((2, 2))
    errors = np.array([[1.0, -1.0], [-0.7, 1.2]]) * _SENSOR_STD
    yield 2, np.array([0.8, 0.4]), 0.5, ids[:2], errors
    for step in range(3, _STEPS + 1):
        odometry = rng.uniform((-1.5, -2.0), (1.5, 2.0)) * (rng.random(2) < 0.9)
        there = ids[: 2 + step // 4]
        some = rng.permutation(there)[: rng.integers(min(len(there), 4) + 1)]
        errors = rng.uniform(-0.4, 0.4, (len(some), 2)) * _SENSOR_STD
        yield step, odometry, float(rng.choice([0.5, 1.0, 2.0])), some.tolist(), errors


def _state(belief: Belief, ids: Sequence[int]) -> _Gaussian | None:
    """Return mean and covariance of the pose and landmarks, None if one is missing."""
    slots = {i: slot for slot, i in enumerate(belief.landmark_ids)}
    if not set(ids) <= set(slots):
        return None
    part = Belief.marginal(belief.mean, belief.covariance, slots, list(ids))
    return _Gaussian(part.covariance, part.mean)


def _is_proper(belief: _Gaussian) -> bool:
    """Return whether a belief is finite, symmetric and definite."""
    P = belief.covariance
    std = np.sqrt(np.abs(P.diagonal()))
    if not (np.isfinite(belief.mean).all() and np.isfinite(P).all() and std.all()):
        return False
    correlations = P / np.outer(std, std)
    return bool(belief.is_symmetric and np.linalg.eigvalsh(correlations)[0] > 1e-9)


def _named(method: str, wrong: Sequence[_Made], fine: Sequence[_Made]) -> Mistake:
    """Name the mistake that explains most of the calls that are wrong."""
    kind = type(wrong[0].call)
    alike = [each for each in fine if type(each.call) is kind and each.used]
    cause, entry = _likely(wrong[:_COMPARED], alike[:_COMPARED]), _entry(wrong[0])
    if alike:
        steps = [str(each.step) for each in wrong]
        where = ", ".join(steps[:5]) + ", …" * (len(steps) > 5)
        entry += f" (in step{'s' * (len(steps) > 1)} {where} of {_STEPS})"
    return Mistake(method, cause, entry)


def _likely(wrong: Sequence[_Made], fine: Sequence[_Made]) -> str:
    """Return the mistake that explains most calls, the first included, "" if none."""
    first = wrong[0]
    is_moved = not first.call.right().agrees(first.got, mean_only=True)
    for mean_only in (False, True) if is_moved else (False,):
        counts = dict.fromkeys(_explanations(first, first, mean_only), 1)
        for each in wrong[1:]:
            for text in counts.keys() & _explanations(first, each, mean_only).keys():
                counts[text] += 1
        best = [text for text, n in counts.items() if n == max(counts.values())]
        if best and 2 * counts[best[0]] >= len(wrong):
            others = [_explanations(first, each, mean_only) for each in fine]
            return max(best, key=lambda text: sum(text in each for each in others))
    return ""


def _explanations(first: _Made, each: _Made, mean_only: bool) -> dict[str, None]:
    """Return the mistakes that lead to the belief after a call, in their order."""
    guesses = _guesses(first, each)
    return dict.fromkeys(
        text for text, guess in guesses if guess.agrees(each.got, mean_only=mean_only)
    )


def _guesses(first: _Made, each: _Made) -> Iterator[tuple[str, _Gaussian]]:
    """Yield the mistakes and the beliefs that each of them leads to."""
    try:
        yield from each.call.mistakes()
        for text, wrong in first.call.fitted(first.got):
            yield text, wrong(each.call)
    except np.linalg.LinAlgError:  # a belief that no factor explains
        return


def _entry(made: _Made) -> str:
    """Write the entry of a belief that is farthest off."""
    right, got = made.call.right(), made.got
    spread, moved = right.gaps(got)
    names = (
        *_POSE,
        *(f"l{k + 1}{axis}" for k in range(len(made.ids)) for axis in "xy"),
    )
    if moved.max() > max(_TOLERANCE, float(spread.max())):
        i = int(moved.argmax())
        what, wanted, found = f"mean[{i}], {names[i]},", right.mean[i], got.mean[i]
        return f"{what} must be {wanted:.5f}, got {found:.5f}"
    i, j = sorted(int(k) for k in np.unravel_index(spread.argmax(), spread.shape))
    what = f"covariance[{i}, {j}], of {names[i]} and {names[j]},"
    wanted, found = right.covariance[i, j], got.covariance[i, j]
    return f"{what} must be {wanted:.3g}, got {found:.3g}"


def _wrong_nis(made: Sequence[_Made]) -> Iterator[Mistake]:
    """Yield that the NIS is not νᵀ S⁻¹ ν, unless it is or none is reported."""
    for each in made:
        call, report = each.call, each.report
        if (
            isinstance(call, _Prediction)
            or report is None
            or not call.slots
            or len(call.new)
        ):
            continue
        if report.degrees_of_freedom != call.known.size or not (right := call.nis) > 1:
            continue
        if abs(report.nis / right - 1) > 0.05:
            text = f"must be νᵀ S⁻¹ ν = {right:.3g}, got {report.nis:.3g}"
            yield Mistake("update().nis " + text, "", "")
            return


def _asymmetric(made: Sequence[_Made]) -> Iterator[Mistake]:
    """Yield that a covariance is not symmetric, where this is within tolerance."""
    for each in made:
        if not each.got.is_symmetric:
            text = f"so it is in step {each.step}"
            yield Mistake("belief()", "the covariance is not symmetric", text)
            return


def _rounded(made: Sequence[_Made]) -> Iterator[Mistake]:
    """Yield that correlations have few decimals, where rounding is within tolerance."""
    for each in made:
        std = np.sqrt(each.got.covariance.diagonal())
        correlations = each.got.covariance / np.outer(std, std)
        gaps = [np.abs(correlations - correlations.round(4)).max()]
        if gaps[0] < 1e-9 and len(np.unique(correlations.round(4))) > 5:
            gaps += [np.abs(correlations - correlations.round(k)).max() for k in (3, 2)]
            decimals = 5 - sum(gap < 1e-9 for gap in gaps)
            cause = f"correlations are rounded to {decimals} decimals"
            yield Mistake("belief()", cause, f"so they are in step {each.step}")
            return
