"""Worlds that lie far from the origin, and how exactly they give the same results.

A coordinate is rounded to its spacing whenever a step changes it. No step makes an
error larger, so that ``steps`` of them leave at most ``steps`` roundings.
"""

import numpy as np
import pytest

FAR = {"1 km": (1e3, -1e3), "UTM": (451234.5, 4412345.25), "1e9 m": (1e9, -1e9)}

far_origins = pytest.mark.parametrize("far", FAR.values(), ids=FAR)


def rounding(far, steps=1):
    """Return by how much coordinates may differ [m]; a little at the origin itself."""
    return steps * np.spacing(np.abs(far).max()) + 1e-11


def moved_world(scenario, far):
    """Return a scenario of random landmarks between walls at another place."""
    twice, pose = np.tile(far, 2), np.add(scenario.start.pose, (*far, 0.0))
    walls = [tuple(np.add(wall, twice)) for wall in scenario.walls]
    bounds = tuple(np.add(scenario.landmarks.bounds, twice))
    return scenario.with_changes(
        start={"pose": tuple(pose)}, walls=walls, landmarks={"bounds": bounds}
    )


def shifted(state, far):
    """Return states (..., 3 + 2n) of the world at another place."""
    moved = np.array(state, dtype=float)
    moved[..., 0] += far[0]
    moved[..., 1] += far[1]
    moved[..., 3::2] += far[0]
    moved[..., 4::2] += far[1]
    return moved
