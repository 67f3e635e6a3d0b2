"""The drive equation of the simulated robot.

Symbols
-------
p = (x, y, θ)     true robot pose in the world frame [m, m, rad]
u = (d, α)        command: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα)  slip, in the frame of the old heading [m, m, rad]

::

    x' = x + (d + εx) cos θ - εy sin θ
    y' = y + (d + εx) sin θ + εy cos θ
    θ' = θ + (α + εα)

The filters' motion model is separate code in `estimator`, which `envs` does not import.
A simulator that shared the filter's model could not reveal an error in it.
"""

from ..angles import Number


def displacement(
    forward: Number, sideways: Number, cos: Number, sin: Number
) -> tuple[Number, Number]:
    """Rotate a displacement from the robot's frame to the world frame.

    Parameters
    ----------
    forward, sideways : float, or ndarray of shape (…,)
        d + εx and εy [m].
    cos, sin : float, or ndarray of shape (…,)
        Of the old heading θ.

    Returns
    -------
    (x' - x, y' - y)
        World frame [m].

    Examples
    --------
    >>> displacement(2.0, 0.5, cos=0.0, sin=1.0)
    (-0.5, 2.0)
    """
    return forward * cos - sideways * sin, forward * sin + sideways * cos
