"""Check how an estimator moves mean and covariance in one call: `step_mistakes`.

If all noise is small, every filter follows the equations of the linear Kalman filter,
whatever its inner coordinates are.  Each call is compared with these equations, from
the belief before the call, so that one mistake does not hide another::

    predict    P' = G P Gᵀ + F R Fᵀ dt
    new l      P_lp = J P,    P_ll = J P Jᵀ + N Q Nᵀ,       J = ∂l/∂p, N = ∂l/∂z
    update     K = P Hᵀ S⁻¹,  S = H P Hᵀ + Q,  P' = P − K S Kᵀ,  x' = x + K ν

A belief that differs is compared with those of frequent mistakes: an entry of a
Jacobian with the wrong sign or missing, a missing covariance, noise that counts too
often.  The finding names the mistake that gives the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array
from .interface import Belief, UpdateReport
from .models.bearing_range import locate_landmark, predict_measurement, wrap_angle
from .models.motions import predict_pose

_MOTION_STD, _SENSOR_STD = (0.002, 0.001, 0.0015), (0.001, 0.003)
_START = {"initial_pose": (1.0, -2.0, 0.6), "initial_pose_std": (5e-4, 1e-3, 1e-3)}
_LANDMARKS, _IDS = np.array([[5.0, 1.0], [2.0, -6.0]]), (4, 9)
_ERRORS = np.array([[1.0, -1.0], [-0.7, 1.2]]) * _SENSOR_STD  # of the second scan
_TOLERANCE = 0.01  # of correlations, and of means in deviations

_POSE, _LANDMARK, _READING = ("x", "y", "θ"), ("lx", "ly"), ("β", "r")
_NAMES = (*_POSE, *(f"l{k + 1}{axis}" for k in range(len(_IDS)) for axis in "xy"))


class _Gaussian(NamedTuple):
    """A belief after a call."""

    covariance: Array
    mean: Array
    nis: float = 0.0

    def gaps(self, other: _Gaussian) -> tuple[Array, Array]:
        """Return how far another belief is away, in deviations of this one."""
        std = np.sqrt(self.covariance.diagonal())
        moved = other.mean - self.mean
        moved[2] = wrap_angle(float(moved[2]))
        spread = np.abs(other.covariance - self.covariance) / np.outer(std, std)
        return spread, np.abs(moved) / std

    def agrees(self, other: _Gaussian) -> bool:
        return max(float(gap.max()) for gap in self.gaps(other)) < _TOLERANCE


class _Call(NamedTuple):
    """One call: its equation, and what the equation needs."""

    method: str
    #: Of both Jacobians and the covariance of the noise.
    equation: Callable[..., _Gaussian]
    jacobians: tuple[Array, Array]
    rows: tuple[str, ...]
    columns: tuple[tuple[str, ...], tuple[str, ...]]
    #: The right one by "", wrong ones by the mistake that leads to them.
    noises: dict[str, Array]
    #: Results of other mistakes.
    others: dict[str, _Gaussian]

    def right(self) -> _Gaussian:
        return self.equation(*self.jacobians, self.noises[""])

    def mistakes(self) -> Iterator[tuple[str, _Gaussian]]:
        """Yield frequent mistakes, each with the belief that it leads to."""
        noise = self.noises[""]
        for which, columns in enumerate(self.columns):
            for (i, row), (j, col) in product(enumerate(self.rows), enumerate(columns)):
                for factor, text in ((-1, "has the wrong sign"), (0, "is missing")):
                    changed = [jacobian.copy() for jacobian in self.jacobians]
                    changed[which][..., i, j] *= factor
                    yield f"∂{row}/∂{col} {text}", self.equation(*changed, noise)
        for text, wrong in self.noises.items():
            yield text, self.equation(*self.jacobians, wrong)
        yield from self.others.items()


def step_mistakes(make: Callable[[Mapping[str, Any]], Any]) -> Iterator[str]:
    """Yield a sentence for each method that does not follow its equation.

    A method whose mean is wrong without noise is left to the checks of the models.

    Parameters
    ----------
    make : callable
        Makes a `SlamEstimator` from the keywords of its constructor.
    """
    slam = make({"motion_std": _MOTION_STD, "measurement_std": _SENSOR_STD, **_START})
    truth, named = np.array(_START["initial_pose"]), set[str]()
    for odometry, dt, errors in (((1.5, 0.7), 3.0, 0.0), ((0.8, 0.4), 0.5, 1.0)):
        call = _prediction(*_state(slam.belief()), np.array(odometry), dt)
        slam.predict(odometry, dt)
        truth = predict_pose(truth, np.array(odometry)).pose
        text = _mistake(call, *_state(slam.belief()))
        if text and call.method not in named:
            named.add(call.method)
            yield text
            if errors:
                return  # a wrong covariance is no start for an update
        readings = predict_measurement(truth, _LANDMARKS).measurement + errors * _ERRORS
        call = (_correction if errors else _addition)(*_state(slam.belief()), readings)
        report = slam.update(readings, _IDS)
        mean, covariance = _state(slam.belief())
        if len(mean) < len(_NAMES):
            return  # a mapping that lacks landmarks has a check of its own
        text = _mistake(call, mean, covariance)
        if text := text or _wrong_nis(call.right().nis, report):
            yield text


def _state(belief: Belief) -> tuple[Array, Array]:
    """Return mean and covariance of the pose and of the landmarks in the map."""
    slots = {i: slot for slot, i in enumerate(belief.landmark_ids)}
    ids = [i for i in _IDS if i in slots]
    part = Belief.marginal(belief.mean, belief.covariance, slots, ids)
    return part.mean, part.covariance


def _mistake(call: _Call, mean: Array, covariance: Array) -> str:
    """Write what is wrong with the belief after a call, "" if nothing is."""
    right, got = call.right(), _Gaussian(covariance, mean)
    spread, moved = right.gaps(got)
    is_of_the_model = call.method != "update()" and moved.max() > _TOLERANCE
    if is_of_the_model or right.agrees(got):
        return ""
    named = (text for text, guess in call.mistakes() if guess.agrees(got))
    because = f"{call.method}: {text}" if (text := next(named, "")) else call.method
    if spread.max() < _TOLERANCE:
        i = int(moved.argmax())
        what, wanted, found = f"mean[{i}], {_NAMES[i]},", right.mean[i], mean[i]
        return f"{because}: {what} must be {wanted:.5f}, got {found:.5f}"
    i, j = sorted(int(k) for k in np.unravel_index(spread.argmax(), spread.shape))
    what = f"covariance[{i}, {j}], of {_NAMES[i]} and {_NAMES[j]},"
    wanted, found = right.covariance[i, j], covariance[i, j]
    return f"{because}: {what} must be {wanted:.3g}, got {found:.3g}"


def _wrong_nis(nis: float, report: UpdateReport) -> str:
    """Write that the NIS is not νᵀ S⁻¹ ν, "" if it is or if none is reported."""
    unknown = not nis or report.degrees_of_freedom != _LANDMARKS.size
    if unknown or abs(report.nis / nis - 1) < _TOLERANCE:
        return ""
    return f"update().nis must be νᵀ S⁻¹ ν = {nis:.3g}, got {report.nis:.3g}"


def _prediction(mean: Array, P: Array, odometry: Array, dt: float) -> _Call:
    """Return P' = G P Gᵀ + F R Fᵀ dt and its mistakes."""
    moved = predict_pose(mean[:3], odometry)
    G, F = moved.jacobian_pose, moved.jacobian_noise

    def equation(G: Array, F: Array, R: Array) -> _Gaussian:
        A = np.eye(len(P))
        A[:3, :3] = G
        after = A @ P @ A.T
        after[:3, :3] += F @ R @ F.T
        return _Gaussian(after, np.append(moved.pose, mean[3:]))

    once = np.diag(np.square(_MOTION_STD))
    R = once * dt
    noises = {
        "": R,
        "the variance of the motion noise is not multiplied by dt": once,
        "the variance of the motion noise is multiplied by dt²": once * dt**2,
        "the variance of the motion noise is multiplied by √dt": once * np.sqrt(dt),
        **_wrong_noises("motion noise", R, np.sqrt(once) * dt),
    }
    ahead = predict_pose(moved.pose, odometry).jacobian_noise
    others = {
        "∂x'/∂θ and ∂y'/∂θ are missing": equation(np.eye(3), F, R),
        "the motion noise is not rotated by the heading": equation(G, np.eye(3), R),
        "the motion noise is rotated by the new heading": equation(G, ahead, R),
    }
    kept, right = P.copy(), equation(G, F, R)
    kept[:3, :3] = right.covariance[:3, :3]
    text = "the covariance of pose and landmarks is not multiplied by G"
    others[text] = right._replace(covariance=kept)
    primed, noise = tuple(f"{name}'" for name in _POSE), ("εx", "εy", "εα")
    columns = _POSE, noise
    return _Call("predict()", equation, (G, F), primed, columns, noises, others)


def _addition(mean: Array, P: Array, readings: Array) -> _Call:
    """Return P with new landmarks and its mistakes."""
    seen = locate_landmark(mean[:3], readings)
    J, N = seen.jacobian_pose, seen.jacobian_measurement
    whole = np.append(mean[:3], seen.position)

    def equation(J: Array, N: Array, Q: Array) -> _Gaussian:
        A = np.vstack([np.eye(3), *J])
        after = A @ P @ A.T
        for k, each in enumerate(N):
            own = slice(3 + 2 * k, 5 + 2 * k)
            after[own, own] += each @ Q @ each.T
        return _Gaussian(after, whole)

    Q = np.diag(np.square(_SENSOR_STD))
    right = equation(J, N, Q)
    no_pose, none, apart = (right.covariance.copy() for _ in range(3))
    no_pose[:3, 3:] = no_pose[3:, :3] = 0
    apart[3:5, 5:] = apart[5:, 3:5] = 0
    none[:3, 3:] = none[3:, :3] = none[3:5, 5:] = none[5:, 3:5] = 0
    texts = {
        "the covariance with the pose is missing": no_pose,
        "the covariance of two new landmarks is missing": apart,
        "all covariances with the pose and other landmarks are missing": none,
    }
    others = {text: right._replace(covariance=wrong) for text, wrong in texts.items()}
    others["the uncertainty of the pose is left out"] = equation(0 * J, N, Q)
    columns, noises = (_POSE, _READING), _sensor_noises(Q)
    method = "update() of new landmarks"
    return _Call(method, equation, (J, N), _LANDMARK, columns, noises, others)


def _correction(mean: Array, P: Array, readings: Array) -> _Call:
    """Return x' and P' after readings of landmarks in the map, and mistakes."""
    expected = predict_measurement(mean[:3], mean[3:].reshape(-1, 2))
    Hp, Hl = expected.jacobian_pose, expected.jacobian_landmark
    innovation = readings - expected.measurement
    innovation[:, 0] = wrap_angle(innovation[:, 0])
    nu = innovation.ravel()

    def gain(Hp: Array, Hl: Array, Q: Array, P: Array) -> tuple[Array, Array]:
        H = np.zeros((len(nu), len(P)))
        H[:, :3] = Hp.reshape(-1, 3)
        for k, each in enumerate(Hl):
            H[2 * k : 2 * k + 2, 3 + 2 * k : 5 + 2 * k] = each
        S = H @ P @ H.T + np.kron(np.eye(len(Hl)), Q)
        return np.asarray(np.linalg.solve(S, H @ P).T), np.asarray(S)

    def corrected(P: Array, K: Array, S: Array) -> _Gaussian:
        nis = float(nu @ np.linalg.solve(S, nu))
        return _Gaussian(P - K @ S @ K.T, mean + K @ nu, nis)

    def equation(Hp: Array, Hl: Array, Q: Array) -> _Gaussian:
        return corrected(P, *gain(Hp, Hl, Q, P))

    Q = np.diag(np.square(_SENSOR_STD))
    right = equation(Hp, Hl, Q)
    apart = P.copy()
    apart[:3, 3:] = apart[3:, :3] = 0
    others = {
        "the covariance is not updated": right._replace(covariance=P),
        "the mean is not updated": right._replace(mean=mean),
        "the innovation has the wrong sign": right._replace(mean=2 * mean - right.mean),
        "the covariance of pose and landmarks is not used": corrected(
            apart, *gain(Hp, Hl, Q, apart)
        ),
    }
    for text, rows in (("pose", slice(3)), ("landmarks", slice(3, None))):
        K, S = gain(Hp, Hl, Q, P)
        K[rows] = 0
        others[f"the gain of the {text} is missing"] = corrected(P, K, S)
    columns, noises = (_POSE, _LANDMARK), _sensor_noises(Q)
    return _Call("update()", equation, (Hp, Hl), _READING, columns, noises, others)


def _sensor_noises(Q: Array) -> dict[str, Array]:
    twice = {"every reading is used twice": Q / 2}
    return {"": Q, **twice, **_wrong_noises("sensor noise", Q, np.sqrt(Q))}


def _wrong_noises(what: str, noise: Array, std: Array) -> dict[str, Array]:
    """Return mistakes of a noise, from its variances and its standard deviations."""
    return {
        f"the {what} is missing": 0 * noise,
        f"standard deviations of the {what} are used as variances": std,
        f"standard deviations of the {what} are in another order": np.diag(
            np.roll(noise.diagonal(), 1)
        ),
        **{
            f"the variance of the {what} is multiplied by {factor:g}": factor * noise
            for factor in (0.25, 0.5, 2, 4)
        },
    }
