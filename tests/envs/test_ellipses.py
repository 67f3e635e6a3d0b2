import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamgym.envs.rendering import covariance_ellipses

finite = st.floats(-5, 5)


def covariance_of(factor):
    return factor @ np.swapaxes(factor, -1, -2)


@given(st.lists(finite, min_size=4, max_size=4), st.floats(0.1, 5))
def test_axes_are_two_sigmas_roots_of_the_eigenvalues(entries, sigmas):
    P = covariance_of(np.reshape(entries, (2, 2)))
    outline = covariance_ellipses(P, sigmas=sigmas)
    smaller, larger = np.maximum(np.linalg.eigvalsh(P), 0)
    # a root turns rounding of size ε in an eigenvalue into √ε
    assert outline.widths == pytest.approx(2 * sigmas * np.sqrt(larger), abs=1e-6)
    assert outline.heights == pytest.approx(2 * sigmas * np.sqrt(smaller), abs=1e-5)


def test_outline_has_constant_mahalanobis_distance():
    P = np.array([[2.0, -0.9], [-0.9, 0.7]])
    width, height, angle = covariance_ellipses(P, sigmas=3.0)
    round_the_circle = np.linspace(0, 2 * np.pi, 50)
    local = np.stack(
        [width / 2 * np.cos(round_the_circle), height / 2 * np.sin(round_the_circle)]
    )
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points = turn @ local
    distance = np.sqrt(np.sum(points * np.linalg.solve(P, points), axis=0))
    np.testing.assert_allclose(distance, 3.0, rtol=1e-12)


def test_batch_shape_is_kept_and_rows_are_independent():
    P = covariance_of(np.random.default_rng(0).normal(size=(4, 5, 2, 2)))
    outline = covariance_ellipses(P)
    assert (
        outline.widths.shape == outline.heights.shape == outline.angles.shape == (4, 5)
    )
    single = covariance_ellipses(P[2, 3])
    np.testing.assert_array_equal([part[2, 3] for part in outline], single)


def test_no_covariances_give_no_ellipses():
    assert covariance_ellipses(np.empty((0, 2, 2))).widths.shape == (0,)


def test_certainty_is_a_point():
    assert covariance_ellipses(np.zeros((2, 2))).widths == 0


def test_eigenvalue_negative_by_rounding_counts_as_zero():
    P = [[1.0, 1.0], [1.0, 1.0 - 1e-15]]
    assert covariance_ellipses(P).heights == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.eye(3), r"shape \(…, 2, 2\), got \(3, 3\)"),
        (np.ones(2), r"shape \(…, 2, 2\), got \(2,\)"),
        ([[1.0, np.nan], [np.nan, 1.0]], "finite"),
        ([[1.0, 0.5], [0.4, 1.0]], "symmetric"),
        ([[1.0, 0.4], [0.5, 1.0]], "symmetric, got entries 0.1 apart"),
        ([[1.0, 2.0], [2.0, 1.0]], "no negative eigenvalue, got -1 m²"),
    ],
)
def test_what_is_no_covariance_is_refused(covariance, message):
    with pytest.raises(ValueError, match=message):
        covariance_ellipses(covariance)


@pytest.mark.parametrize("sigmas", [0.0, -1.0, np.nan])
def test_sigmas_must_be_positive(sigmas):
    with pytest.raises(ValueError, match="sigmas must be > 0"):
        covariance_ellipses(np.eye(2), sigmas=sigmas)
