"""Compare beliefs, observations, states and folders to the bit."""

import hashlib

import numpy as np


def assert_same_bits(one, other):
    """Assert that two beliefs are equal to the bit."""
    assert one.landmark_ids == other.landmark_ids
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


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
    return {
        key: (str(np.asarray(value).dtype), np.asarray(value).tobytes())
        for key, value in slam.state_dict().items()
    }


def tree(path):
    """Digest a file, or every file below a folder, by its path."""
    files = [path] if path.is_file() else sorted(path.rglob("*"))
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
        if file.is_file()
    }
