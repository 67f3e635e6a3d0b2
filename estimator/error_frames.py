"""The error of a belief, in the coordinates in which a filter's covariance lives.

Additive: e = x − x̂, the heading wrapped.  Invariant: the coordinates of SE_{1+n}(2),
in which a turn of the whole map is a straight line.  With t = θ − θ̂ and every point q,
the robot's position and each landmark::

    ξ_θ = t,    ξ_q = V(t)⁻¹ (q − R(t) q̂),    to first order  ξ = D e
    D = I − (J q̂; 0 at θ) e_θᵀ,    J = [0 −1; 1 0]

where V(t) = [sin t, −(1 − cos t); 1 − cos t, sin t] / t (Barrau and Bonnabel, 2015).
Where the heading is uncertain, positions are spread over an arc: a banana in additive
coordinates, an ellipse in these.  States are (x, y, θ, l1x, l1y, …).
"""

from typing import Literal, get_args

import numpy as np

from ..arrays import Array, ComplexArray
from .models.angles import wrap_angle
from .models.rigid_motion import left_jacobian

ErrorFrame = Literal["additive", "invariant"]
ERROR_FRAMES: tuple[ErrorFrame, ...] = get_args(ErrorFrame)


def additive_error(true_state: Array, mean: Array) -> Array:
    """Return e = x − x̂ with the heading wrapped, over any leading axes.

    Parameters
    ----------
    true_state, mean : ndarray, shape (..., 3 + 2n)
        True and estimated state.

    Returns
    -------
    ndarray, shape (..., 3 + 2n)

    Examples
    --------
    >>> additive_error(np.array([1.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1]))
    array([ 1.        ,  0.        , -0.08318531])
    """
    error = np.asarray(true_state - mean)
    error[..., 2] = wrap_angle(error[..., 2])
    return error


def invariant_error(true_state: Array, mean: Array) -> Array:
    """Return ξ = Log(χ χ̂⁻¹), over any leading axes.

    Parameters
    ----------
    true_state, mean : ndarray, shape (..., 3 + 2n)
        True and estimated state.

    Returns
    -------
    ndarray, shape (..., 3 + 2n)

    Examples
    --------
    A map that is turned as a whole, robot and all, is wrong by its heading alone:

    >>> estimate = np.array([1.0, 0.0, 0.0, 3.0, 0.0])
    >>> truth = np.array([0.0, 1.0, np.pi / 2, 0.0, 3.0])
    >>> np.allclose(invariant_error(truth, estimate), [0, 0, np.pi / 2, 0, 0])
    True
    """
    turn = wrap_angle(np.asarray(true_state[..., 2] - mean[..., 2]))
    true_points, points = _points(true_state), _points(mean)
    moved = true_points - np.exp(1j * turn)[..., None] * points
    return _state(moved / left_jacobian(turn)[..., None], turn)


def invariant_covariance(mean: Array, covariance: Array) -> Array:
    """Return D P Dᵀ, the covariance of ξ for a covariance P of e; any leading axes.

    Parameters
    ----------
    mean : ndarray, shape (..., 3 + 2n)
    covariance : ndarray, shape (..., 3 + 2n, 3 + 2n)

    Returns
    -------
    ndarray, shape (..., 3 + 2n, 3 + 2n)
    """
    lever = _state(1j * _points(mean), np.zeros(mean.shape[:-1]))[..., :, None]
    half = covariance - lever * covariance[..., 2:3, :]
    return np.asarray(half - np.swapaxes(lever, -1, -2) * half[..., :, 2:3])


def _points(state: Array) -> ComplexArray:
    """Robot position and landmarks as complex numbers, shape (..., 1 + n)."""
    x = np.concatenate([state[..., :1], state[..., 3::2]], axis=-1)
    y = np.concatenate([state[..., 1:2], state[..., 4::2]], axis=-1)
    return np.asarray(x + 1j * y)


def _state(points: ComplexArray, heading: Array) -> Array:
    pairs = np.stack([points.real, points.imag], axis=-1)
    flat = pairs.reshape(*points.shape[:-1], -1)
    return np.concatenate([flat[..., :2], heading[..., None], flat[..., 2:]], axis=-1)
