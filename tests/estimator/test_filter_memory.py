"""The memory of a filter: growth, identities, copies, pickles, reports."""

import copy
import pickle
from itertools import combinations
from weakref import ref

import numpy as np
import pytest
from comparison import assert_same_bits, digest, part_of

from slamgym.estimator import EkfSlam, UpdateReport, make_estimator
from slamgym.estimator.filters.gaussian_map import LOWER
from slamgym.estimator.kernels.scan_update import LARGE

NOISE = {"motion_std": (0.05, 0.02, 0.01), "measurement_std": (0.03, 0.1)}
FAMILY = (
    *("ekf", "invariant", "first_estimates", "observability_constrained"),
    *("iterated", "ideal", "robocentric", "unscented"),
)
SMOOTHER = "slamgym.estimator.smoother.recorded_slam:SmoothingSlam"
REPORTING = (*FAMILY, "compressed", "sparse_information", "submaps", SMOOTHER)


def scans(seed, identities, steps=60, most=6):
    """Odometry and scans of random landmarks on a plane, seen from a circle."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-8, 8, (len(identities), 2))
    for k in range(steps):
        heading = 0.1 * k
        offset = places - (5 * np.sin(heading), 5 - 5 * np.cos(heading))
        seen = rng.permutation(len(places))[: rng.integers(most + 1)]
        bearing = np.arctan2(*offset[seen].T[::-1]) - heading
        readings = np.column_stack([bearing, np.hypot(*offset[seen].T)])
        yield (0.5, 0.1), readings + rng.normal(0, 0.02, readings.shape), seen


IDENTITIES = {
    "in order": list(range(40)),
    "negative": [-1 - 7 * k for k in range(40)],
    "far apart": [k << 32 for k in range(20)] + [k * 2**20 for k in range(21, 41)],
    "at the ends": [2**63 - 1 - k for k in range(20)]
    + [2**20 - 2**63 + k for k in range(20)],
}


@pytest.mark.parametrize("label", IDENTITIES)
def test_the_belief_does_not_depend_on_the_identities(label):
    identities = IDENTITIES[label]
    slam, plain = make_estimator("ekf", **NOISE), make_estimator("ekf", **NOISE)
    for k, (u, z, seen) in enumerate(scans(0, identities)):
        ids = [identities[i] for i in seen]
        for each in (slam, plain):
            each.predict(u)
        report, expected = slam.update(z, ids), plain.update(z, seen)
        assert report.added_ids == tuple(identities[i] for i in expected.added_ids)
        if k % 20 == 10:  # the table is made anew
            slam.remove(slam.landmark_ids[:3])
            plain.remove(plain.landmark_ids[:3])
    assert slam.landmark_ids == tuple(identities[i] for i in plain.landmark_ids)
    np.testing.assert_array_equal(slam.belief().mean, plain.belief().mean)


@pytest.mark.parametrize("name", FAMILY)
@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda slam: pickle.loads(pickle.dumps(slam))]
)
def test_a_copy_continues_alone_bit_for_bit(name, copied):
    steps = list(scans(1, range(30), steps=12))
    slam = make_estimator(name, **NOISE)
    for u, z, seen in steps[:6]:
        slam.predict(u)
        slam.update(z, seen)
    twin, before = copied(slam), digest(slam)
    for u, z, seen in steps[6:]:
        twin.predict(u)
        twin.update(z, seen)
    assert digest(slam) == before
    for u, z, seen in steps[6:]:
        slam.predict(u)
        slam.update(z, seen)
    assert digest(twin) == digest(slam)


@pytest.mark.parametrize("name", FAMILY)
def test_a_report_keeps_its_results_while_the_filter_goes_on(name):
    slam, twin = make_estimator(name, **NOISE), make_estimator(name, **NOISE)
    kept, read = [], []
    for u, z, seen in scans(2, range(40), steps=25, most=12):
        for each in (slam, twin):
            each.predict(u)
        kept.append(slam.update(z, seen))
        report = twin.update(z, seen)
        read.append(report.replace())  # reads all of it at once
    for late, early in zip(kept, read, strict=True):
        assert late == early
    assert pickle.loads(pickle.dumps(kept[-1])) == copy.deepcopy(kept[-1]) == read[-1]


@pytest.mark.parametrize(
    ("name", "options"),
    [(name, {}) for name in ("ekf", "invariant", "iterated", "robocentric")]
    + [("unscented", {}), ("unscented", {"gate_probability": 0.99})]
    + [(name, {}) for name in ("first_estimates", "observability_constrained")]
    + [("ekf", {"gate_probability": 0.99}), ("invariant", {"iterations": 1})],
)
def test_a_large_covariance_is_completed_when_it_is_read(name, options):
    slam, read = (make_estimator(name, **NOISE, **options) for _ in range(2))
    seen_first, was_lower = list(range(150)), False
    for k, (u, z, seen) in enumerate(scans(0, seen_first, steps=22, most=150)):
        few = len(seen) if k < 9 else 3 + 2 * k
        for each in (slam, read):
            each.predict(u)
            each.update(z[:few], seen[:few])
            if k == 15:
                each.remove(each.landmark_ids[3:5])
        was_lower |= bool(slam.map.parts.numbers[LOWER])
        covariance = read.map.covariance  # of a map that is complete after every step
        assert not read.map.parts.numbers[LOWER]
        np.testing.assert_array_equal(covariance, covariance.T)
        if k == 18:
            slam = copy.deepcopy(slam)
    assert was_lower == (name != "robocentric")
    assert slam.map.size > LARGE
    np.testing.assert_array_equal(slam.map.mean, read.map.mean)
    np.testing.assert_array_equal(slam.map.covariance, read.map.covariance)


@pytest.mark.parametrize("seen", [[], [120, 3, 77], list(range(140, 20, -1))])
def test_a_part_of_a_large_belief_is_read_from_the_lower_half(seen):
    slam = make_estimator("invariant", **NOISE)
    for k, (u, z, ids) in enumerate(scans(0, list(range(150)), steps=12, most=150)):
        few = len(ids) if k < 9 else 30
        slam.predict(u)
        slam.update(z[:few], ids[:few])
    assert slam.map.parts.numbers[LOWER]
    part = slam.belief(seen)
    is_whole = 8 * len(seen) >= len(slam.landmark_ids)
    assert slam.map.parts.numbers[LOWER] == (not is_whole)
    assert_same_bits(part, part_of(slam.belief(), seen))


def test_the_parts_of_a_memory_are_apart():
    slam = make_estimator(
        "iterated", motion_std=(0.1, 0.1, 0.1), measurement_std=(0.1, 0.1)
    )
    for one, other in combinations(slam.map.parts, 2):
        assert not np.shares_memory(one, other)


def test_the_readings_of_a_report_are_read_without_a_copy_of_its_rows():
    slam = make_estimator("ekf", gate_probability=0.99, min_range=0.5, **NOISE)
    places = np.random.default_rng(5).uniform(2, 9, (40, 2))
    for first in range(0, 40, 10):
        slam.update(places[first : first + 10], range(first, first + 10))
    scan = [places[3], places[7] + (1.0, 3.0), (0.0, 0.1), (0.4, 5.0)]
    report = slam.update(scan, [3, 7, 8, 50])
    found = (
        report.degrees_of_freedom,
        report.associated_ids,
        report.rejected_ids,
        report.skipped_ids,
        report.added_ids,
        report.near_ids,
    )
    assert found[:5] == (2, (3,), (7,), (8,), (50,))
    assert "_record" not in vars(report)
    held = slam.update(places[:4], range(4))
    slam.update(places[:1], [0])
    assert (held.degrees_of_freedom, held.associated_ids) == (8, (0, 1, 2, 3))
    assert report.replace().near_ids == found[5]


def test_the_last_report_is_the_one_that_is_still_held():
    slam = make_estimator("ekf", **NOISE)
    report = slam.update([(0.1, 3.0)], [4])
    assert slam.report() is report
    slam.predict((1.0, 0.0))
    assert slam.report() is report
    slam.update([(0.2, 4.0)], [5])
    assert slam.report().added_ids == (5,)
    assert report.added_ids == (4,)


@pytest.mark.parametrize("management", [None, True])
@pytest.mark.parametrize("change", ["remove", "resume"])
def test_a_report_that_is_held_does_not_keep_a_memory_that_was_replaced(
    management, change
):
    large = make_estimator("ekf", management=management, **NOISE)
    large.update([(0.1 * k, 3.0) for k in range(30)], range(30))
    slam, twin = (
        make_estimator("ekf", management=management, **NOISE) for _ in range(2)
    )
    scan = [(0.1, 3.0), (0.2, 4.0)], [4, 5]
    report, expected = slam.update(*scan), twin.update(*scan).replace()
    gaussian = slam.map if management is None else slam.filter.map
    memory = ref(gaussian.block.base)
    if change == "remove":
        slam.remove([4])
    else:
        slam.resume(large.snapshot())
    assert memory() is None
    assert report == expected


@pytest.mark.parametrize("name", REPORTING)
def test_the_report_before_the_first_scan_is_empty(name):
    slam = make_estimator(name, **NOISE)
    slam.predict((1.0, 0.0))
    assert slam.report().replace() == UpdateReport()


@pytest.mark.parametrize("name", REPORTING)
def test_a_report_is_that_of_the_last_scan_or_empty(name):
    slam = make_estimator(name, **NOISE)
    for scan in ([(0.1, 4.0), (0.5, 3.0), (-0.5, 5.0)], [(0.12, 3.1), (0.6, 2.1)]):
        slam.predict((1.0, 0.0))
        slam.update(scan, [*range(len(scan))])
    last, empty = slam.report().replace(), UpdateReport()
    assert last.nis > 0

    def after(change):
        changed = copy.deepcopy(slam)
        change(changed)
        again = pickle.loads(pickle.dumps(changed)).report().replace()
        assert changed.report().replace() == again
        return again

    assert after(lambda s: s.predict((1.0, 0.0))) == last
    assert after(lambda s: s.remove([2])) in (last, empty)
    assert after(lambda s: s.merge(0, 2)) in (last, empty)
    assert after(lambda s: s.load_state_dict(s.state_dict())) == empty
    assert after(lambda s: s.reset((0, 0, 0), (0, 0, 0))) == empty


def test_steps_count_what_the_belief_has_taken_in_and_nothing_else():
    slam = make_estimator("ekf", **NOISE)
    before = slam.steps
    slam.predict((1.0, 0.0))
    slam.update([(0.1 * k, 3.0) for k in range(30)], range(30))  # grows
    assert slam.steps == before + 2
    slam.remove([3])
    slam.merge(4, 5)
    with pytest.raises(ValueError, match="twice"):
        slam.update([(0.1, 3.0), (0.2, 3.0)], [1, 1])
    assert slam.steps == before + 2


def test_steps_and_report_go_on_where_a_dense_map_becomes_sparse():
    slam = make_estimator("sparse_information", **NOISE, dense_limit=2)
    slam.predict((1.0, 0.0))
    slam.update([(0.0, 2.0), (0.5, 3.0)], [1, 2])
    assert (slam.steps, slam.report().added_ids) == (2, (1, 2))
    report = slam.update([(0.0, 2.0), (1.0, 3.0)], [1, 3])
    assert slam.steps == 3
    assert slam.report() is report
    assert report.added_ids == (3,)
    slam.predict((1.0, 0.0))
    slam.update([], [])
    assert (slam.steps, slam.report().added_ids) == (5, ())


@pytest.mark.parametrize("ids", [[7, 8, 7], [1, 9, 9], [9, 1, 9]])
def test_a_repeated_landmark_is_refused_mapped_or_not(ids):
    slam = make_estimator("ekf", **NOISE)
    slam.update([(0.0, 2.0), (0.5, 3.0)], [1, 7])
    before = digest(slam)
    with pytest.raises(ValueError, match="must not repeat within a scan, got"):
        slam.update([(0.0, 2.0), (0.1, 3.0), (0.2, 4.0)], ids)
    assert digest(slam) == before


@pytest.mark.parametrize("name", ["ekf", "invariant", "robocentric"])
def test_reports_that_are_kept_stay_as_they_are_when_a_filter_resumes(name):
    slam = make_estimator(name, **NOISE)
    slam.update([(0.5, 4.0)], [3])
    before, kept = slam.snapshot(), []
    for _ in range(2):
        slam.predict((0.5, 0.1))
        kept.append(slam.update([(0.4, 3.4)], [3]))
        slam.resume(before)
        slam.update([], [])
    assert kept[0].innovation.any()
    assert np.array_equal(kept[0].innovation, kept[1].innovation)
    assert np.array_equal(kept[0].innovation_factor, kept[1].innovation_factor)


@pytest.mark.parametrize("name", FAMILY)
def test_a_filter_resumes_with_the_report_that_it_had(name):
    slam = make_estimator(name, **NOISE)
    start = slam.snapshot()
    slam.update([(0.5, 4.0)], [3])
    after, added = slam.snapshot(), slam.report().added_ids
    slam.resume(start)
    assert slam.report() == UpdateReport()
    slam.resume(after)
    assert slam.report().added_ids == added == (3,)


class Counting(EkfSlam):
    """Counts the scans of each landmark in an array and lists their sizes."""

    def __init__(self, **options):
        super().__init__(**options)
        self.counts, self.sizes = np.zeros(9), []

    def update(self, measurements, landmark_ids=None):
        self.counts[landmark_ids] += 1
        self.sizes.append(len(landmark_ids))
        return super().update(measurements, landmark_ids)


def test_a_snapshot_holds_copies_of_what_a_filter_of_your_own_changes_in_place():
    one, other = Counting(**NOISE), Counting(**NOISE)
    one.update([(0.5, 4.0)], [3])
    before = one.snapshot()
    for slam in (one, other, other):
        slam.resume(before)
        slam.update([(0.5, 4.0), (0.1, 5.0)], [3, 4])
        assert slam.counts.tolist() == [0, 0, 0, 2, 1, 0, 0, 0, 0]
        assert slam.sizes == [1, 2]
    assert one.counts.tolist() == other.counts.tolist()


@pytest.mark.parametrize("name", ["ekf", "iterated"])
def test_a_resumed_filter_reports_its_last_scan_once_more(name):
    slam, larger = make_estimator(name, **NOISE), make_estimator(name, **NOISE)
    scan, ids = np.array([(0.1, 3.0), (1.0, 4.0), (-1.0, 5.0)]), [4, 7, 9]
    slam.update(scan, ids)
    expected, kept = slam.update(scan + 0.02, ids).replace(), slam.snapshot()
    slam.update(scan[:1], ids[:1])
    larger.update(np.tile(scan, (8, 1)), range(24))
    for each in (slam, larger):
        each.resume(kept)
        found = each.report()
        assert found.associated_ids == expected.associated_ids
        assert found.nis == expected.nis
        np.testing.assert_array_equal(found.innovation, expected.innovation)
        np.testing.assert_array_equal(
            found.innovation_factor, expected.innovation_factor
        )
