"""The random numbers of an episode by numpy and the standard library, one by one."""

from statistics import NormalDist

import numpy as np
from gymnasium.utils import seeding

NAMES = ("start", "map", "motion", "measurement", "dropout", "clutter", "order")


def first_key(seed):
    """The key of the first episode after ``reset(seed=seed)``."""
    rng, _ = seeding.np_random(seed)
    return rng.bit_generator.random_raw(2)


def philox(key, name, step=0):
    counter = np.array([0, step, NAMES.index(name), 0], dtype=np.uint64)
    return np.random.Philox(key=key, counter=counter)


def uniforms(key, name, count, step=0):
    return np.random.Generator(philox(key, name, step)).random(count)


def normals(key, name, count, step=0):
    words = philox(key, name, step).random_raw(count).tolist()
    middle = [((word >> 12) + 0.5) / 2**52 for word in words]
    return np.array([NormalDist().inv_cdf(u) for u in middle])
