"""Central differences, the independent check of every analytic Jacobian."""

import numpy as np


def numeric_jacobian(function, point, step=1e-6):
    """Return ∂function/∂point, shape (*output, n)."""
    point = np.asarray(point, dtype=float)
    columns = [
        (function(point + step * e) - function(point - step * e)) / (2 * step)
        for e in np.eye(len(point))
    ]
    return np.stack(columns, axis=-1)
