"""Tests of the final map: which maps are accepted, and which are rejected."""

import numpy as np
import pytest
from scipy import stats

from slamgym.evaluation.hypothesis_tests import equivalence_test
from slamgym.evaluation.map_consistency import MapEvidence, map_test

HONEST = np.random.default_rng(4).standard_normal((100, 20, 2))


def test_an_honest_map_is_shown_to_be_consistent():
    found = map_test(HONEST)
    assert found.shown
    every = np.stack([found.p_values, found.map_p_values, found.mean_p_values])
    assert ((every >= 0) & (every <= 1)).all()


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_one_landmark_of_twenty_with_a_wrong_covariance_is_rejected(factor):
    errors = HONEST.copy()
    errors[:, 7] *= factor
    found = map_test(errors)
    assert not found.accepted
    assert found.landmarks[found.landmark_p_values.argmin()] == 7


def test_a_mean_error_that_is_hidden_in_the_squares_is_rejected():
    errors = HONEST.copy()
    errors[:, 3, 0] += 0.8
    found = map_test(errors)
    assert not found.accepted
    assert found.mean_p_values.min() < found.p_values.min()


@pytest.mark.parametrize(("offset", "accepted"), [(0.24, True), (0.33, False)])
def test_a_mean_error_counts_beyond_a_quarter_of_a_deviation(offset, accepted):
    errors = np.random.default_rng(5).standard_normal((3000, 1, 2))
    errors += (offset, 0.0) - errors.mean(axis=0)
    assert map_test(errors).accepted == accepted


def test_a_landmark_that_some_maps_lack_is_tested_over_the_others():
    errors = HONEST.copy()
    errors[60:, 3] = np.nan
    found, alone = map_test(errors), map_test(HONEST[:60])
    assert found.p_values[3] == alone.p_values[3]
    assert found.mean_p_values[3] == alone.mean_p_values[3]


def test_wrong_covariances_between_landmarks_are_rejected_by_the_whole_map():
    nees, freedom = 2 * (HONEST**2).sum(axis=(1, 2)), np.full(100, 40)
    assert not map_test(HONEST, nees, freedom).accepted


def test_a_matrix_with_a_negative_eigenvalue_is_rejected():
    nees, freedom = (HONEST**2).sum(axis=(1, 2)), np.full(100, 40)
    text = map_test(HONEST, nees, freedom).sentence()
    assert "no NEES" not in text
    assert "in the frame of the map" not in text
    nees[5:7] = np.inf, np.nan
    found = map_test(HONEST, nees, freedom)
    assert not found.accepted
    assert (found.indefinite, found.undefined, found.all_runs) == (1, 1, 100)
    assert "; 2 of 100 maps have no NEES: rejected" in found.sentence()


def test_of_maps_without_any_nees_those_whose_landmarks_are_known_are_tested():
    errors, freedom = HONEST[:10].copy(), np.full(10, 40)
    errors[3, 0] = np.inf
    nees = np.full(10, np.inf)
    nees[[7, 8]], freedom[[7, 8]] = np.nan, 0  # no map
    found = map_test(errors, nees, freedom)
    assert (found.runs, found.indefinite, found.joint) == (7, 8, False)


def test_a_map_without_nees_is_not_shown_to_be_consistent():
    errors = HONEST.copy()
    errors[0, 0] = np.inf
    found = map_test(errors)
    assert found.accepted
    assert not found.shown


def p_outside(total, freedom):
    """Return the p-value of a sum of NEES, if it is χ² times 0.8 to 1.25."""
    tails = stats.chi2.cdf(total / 0.8, freedom), stats.chi2.sf(total / 1.25, freedom)
    return min(1.0, 2 * min(tails))


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("size", [1.0, 1.25, 0.8])
def test_a_report_is_made_of_sums_over_the_runs_that_map_a_landmark(joint, size):
    rng = np.random.default_rng(8)
    errors = size * np.linspace(0.9, 1.2, 6)[:, None] * rng.standard_normal((31, 6, 2))
    errors[rng.random((31, 6)) < 0.2] = np.nan
    errors[3:, 4], errors[5], errors[6, 0] = np.nan, np.nan, np.inf
    in_map, whole = rng.chisquare(2, (31, 6)), size * rng.chisquare(10, 31)
    freedom = np.where(np.isnan(errors[..., 0]).all(axis=1), 0, 10)
    given = (whole, freedom) if joint else ()
    found = map_test(errors, *given, landmark_nees=in_map)
    kept = [run for run in range(31) if run not in (5, 6)]
    squares = (errors[kept] ** 2).sum(axis=2)
    known = ~np.isnan(squares)
    assert (found.runs, found.undefined, found.all_runs) == (29, 1, 30)
    assert (found.joint, found.indefinite) == (joint, 0)
    assert found.landmarks.tolist() == [0, 1, 2, 3, 5]
    count = len(found.landmarks)
    for place, k in enumerate(found.landmarks):
        rows = known[:, k]
        n = 2 * rows.sum()
        total, alone = squares[rows, k].sum(), in_map[kept][rows, k].sum()
        mean = errors[kept][rows, k].mean(axis=0)
        expected = {
            "ratios": total / n,
            "p_values": min(1, count * p_outside(total, n)),
            "map_ratios": alone / n,
            "map_p_values": min(1, count * p_outside(alone, n)),
            "means": mean,
            "mean_p_values": min(
                1, count * stats.ncx2.sf(n / 2 * mean @ mean, 2, n / 2 * 0.25**2)
            ),
        }
        for name, value in expected.items():
            assert getattr(found, name)[place] == pytest.approx(value, rel=1e-6), name
    totals = whole[kept] if joint else np.nansum(squares, axis=1)
    sizes = freedom[kept] if joint else 2 * known.sum(axis=1)
    together = p_outside(totals.sum(), sizes.sum()) if joint else 1.0
    assert found.joint_p_value == pytest.approx(together)
    assert found.equivalence == equivalence_test(totals / sizes, 1)
    each = [found.p_values, found.map_p_values, found.mean_p_values]
    assert found.p_value == pytest.approx(min(1, 4 * min(together, np.min(each))))
    np.testing.assert_array_equal(found.landmark_p_values, np.min(each, axis=0))
    worst = abs(np.log(found.ratios)).argmax()
    in_frame = abs(np.log(found.map_ratios)).argmax()
    sizes = np.linalg.norm(found.means, axis=1)
    low, high = found.equivalence.interval
    what = "whole map" if joint else "average over the landmarks"
    assert found.sentence() == (
        f"Map at the end, {what}: ratio {(found.equivalence.statistic):.3f}, 90 % "
        f"interval [{low:.3f}, {high:.3f}]; landmark {found.landmarks[worst]} seen "
        f"from the robot has {found.ratios[worst]:.3g}; landmark "
        f"{found.landmarks[in_frame]} in the frame of the map has "
        f"{found.map_ratios[in_frame]:.3g}; the largest mean error is "
        f"{sizes.max():.2f} deviations (landmark {found.landmarks[sizes.argmax()]}); "
        f"1 of 30 maps have no NEES: {'accepted' if found.accepted else 'rejected'}, "
        f"p = {found.p_value:.2g} (rejects a consistent map in at most 0.5%)."
    )


def test_two_maps_are_enough_and_one_is_not():
    assert map_test(HONEST[:1]) is None
    assert map_test(HONEST[:2]).landmarks.tolist() == list(range(20))
    none = np.full((3, 20, 2), np.nan)
    assert map_test(none) is None
    half = HONEST[:7].copy()
    half[3:, 2], half[4:, 3] = np.nan, np.nan  # of 3 and of 4 maps out of 7
    assert 2 not in map_test(half).landmarks
    assert 3 in map_test(half).landmarks


# after every run


def scores_of(errors):
    """Final maps of landmarks whose errors are independent; nan where unknown."""
    squares = (errors**2).sum(axis=2)
    freedom = 2 * np.isfinite(squares).sum(axis=1)
    return errors, np.nansum(squares, axis=1), freedom, squares


def evidence(errors):
    return MapEvidence().update(*scores_of(errors))[0]


@pytest.mark.parametrize("factor", [np.sqrt(0.8), 1.0, np.sqrt(1.25)])
def test_maps_inside_the_margin_are_rarely_rejected_at_any_look(factor):
    rng = np.random.default_rng(12)
    shape, most = (60, 8, 2), []
    for _ in range(60):
        errors = factor * rng.standard_normal(shape)
        errors[rng.random(shape[:2]) < 0.3] = np.nan
        most.append(evidence(errors).max())
    assert np.mean(np.array(most) > np.log(20)) < 0.1


@pytest.mark.parametrize(
    "change",
    [
        lambda errors: 2 * errors,
        lambda errors: 0.5 * errors,
        lambda errors: errors + np.array([0.0, 1.2]),
        lambda errors: errors * np.where(np.arange(20) == 7, 3.0, 1.0)[:, None],
    ],
)
def test_wrong_maps_are_rejected_soon(change):
    assert evidence(HONEST).max() < np.log(20)
    assert evidence(change(HONEST))[30] > np.log(200)


@pytest.mark.parametrize("which", [1, 3])
def test_errors_that_only_the_whole_map_or_its_own_frame_shows_are_rejected(which):
    parts = list(scores_of(HONEST))
    parts[which] = 3 * parts[which]
    assert MapEvidence().update(*parts)[0][30] > np.log(200)


def test_landmarks_without_a_nees_in_the_map_are_no_evidence():
    parts = scores_of(HONEST)
    parts[3][:, 5:] = np.nan
    assert MapEvidence().update(*parts)[0].max() < np.log(20)


def test_a_negative_eigenvalue_is_certain_evidence_from_its_run_on():
    parts = scores_of(HONEST.copy())
    parts[1][5] = np.inf
    watched = MapEvidence()
    found, ratios = watched.update(*(part[:10] for part in parts))
    assert np.isfinite(found[:5]).all()
    assert np.isinf(found[5:]).all()
    assert np.flatnonzero(np.isnan(ratios)).tolist() == [5]
    assert np.isinf(watched.update(*(part[10:] for part in parts))[0]).all()
    assert watched.undefined == 0


def test_runs_without_a_map_or_its_nees_add_no_evidence_and_the_latter_are_counted():
    errors = 5 * HONEST[:4]
    parts = scores_of(errors)
    parts[2][1], parts[1][2] = 0, np.nan
    watched = MapEvidence()
    found, ratios = watched.update(*parts)
    assert found[0] == found[1] == found[2] < found[3]
    assert np.isnan(ratios).tolist() == [False, True, True, False]
    assert ratios[0] == parts[1][0] / 40
    assert watched.undefined == 1


def test_a_map_with_a_singular_landmark_is_undefined():
    parts = scores_of(HONEST[:4].copy())
    parts[0][2, 7], parts[3][2, 7] = np.inf, np.nan
    watched = MapEvidence()
    assert np.isnan(watched.update(*parts)[1]).tolist() == [False, False, True, False]
    assert watched.undefined == 1


def test_huge_errors_of_a_map_are_evidence_without_an_overflow():
    parts = scores_of(HONEST.copy())
    parts[1][:3] = 1.7e308
    found = MapEvidence().update(*parts)[0]
    assert np.isfinite(found).all()
    assert found[0] > np.log(200)
