"""Compare beliefs, observations, states and folders to the bit."""

import hashlib

import numpy as np


def assert_same_bits(one, other):
    """Assert that two beliefs are equal to the bit."""
    assert one.landmark_ids == other.landmark_ids
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def assert_close_beliefs(one, other, atol=1e-9, covariance_atol=None):
    """Assert that two beliefs of the same landmarks are equal but for rounding."""
    assert one.landmark_ids == other.landmark_ids
    covariance_atol = atol if covariance_atol is None else covariance_atol
    close = np.testing.assert_allclose
    close(one.mean, other.mean, rtol=0, atol=atol)
    close(one.covariance, other.covariance, rtol=0, atol=covariance_atol)


def entries_of(belief, ids):
    """Return where the pose and some landmarks stand in the state of a belief."""
    slots = np.array([belief.landmark_ids.index(i) for i in ids], dtype=int)
    return np.r_[0:3, 3 + (2 * slots[:, None] + [0, 1]).ravel()]


def part_of(belief, ids):
    """Return the belief about the pose and some landmarks, from the whole one."""
    at = entries_of(belief, ids)
    covariance = belief.covariance[np.ix_(at, at)]
    return type(belief)(belief.mean[at], covariance, tuple(ids), belief.frame)


def same(value, other):
    """Assert equality of keys, shapes, dtypes and numbers in nested containers."""
    if isinstance(value, dict):
        assert list(value) == list(other)
        for key in value:
            same(value[key], other[key])
    elif isinstance(value, tuple | list):
        for each, its in zip(value, other, strict=True):
            same(each, its)
    else:
        np.testing.assert_array_equal(value, other)
        assert np.asarray(value).dtype == np.asarray(other).dtype


def digest(slam):
    """Return the whole state of a filter, to the bit."""

    def bits(array):
        return repr(array) if array.dtype == object else array.tobytes()

    state = {key: np.asarray(value) for key, value in slam.state_dict().items()}
    return {key: (str(array.dtype), bits(array)) for key, array in state.items()}


def tree(path):
    """Digest a file, or every file below a folder, by its path."""
    files = [path] if path.is_file() else sorted(path.rglob("*"))
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
        if file.is_file()
    }
