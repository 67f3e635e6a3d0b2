"""The joint assignment of a scan, against all assignments that there are."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from plain_association import assign_plainly, innovations_of, predicted_readings, solve
from scipy.stats import chi2

from slamgym.estimator.association.scan_assignments import (
    AMBIGUOUS,
    NEW,
    Noise,
    assign_scan,
)
from slamgym.estimator.interface import MapView
from slamgym.estimator.kernels.assignment_search import (
    SURE,
    UNPAIRED,
    Problem,
    largest_change,
)
from slamgym.estimator.map_management.policy import LandmarkPolicy
from slamgym.estimator.models.bearing_range import predict_measurement

MISSING = 2.0


def random_problem(rng, *, pairs_first=False):
    """Return a problem of up to five readings, with a random covariance."""
    landmarks, rows = rng.integers(1, 6, 2)
    mean = rng.normal(scale=3.0, size=3 + 2 * landmarks)
    root = rng.normal(scale=0.15, size=(len(mean), len(mean)))
    expected, joint = predicted_readings(mean, root @ root.T, np.arange(landmarks))
    readings = np.column_stack([rng.uniform(-3, 3, rows), rng.uniform(0.5, 5, rows)])
    limits = np.full(rows + 1, np.inf)
    if pairs_first:
        limits = np.append(0.0, chi2.ppf(0.95, 2 * np.arange(1, rows + 1)))
    return Problem(
        innovations_of(readings, expected),
        joint,
        rng.uniform(0.1, 0.5, (rows, landmarks, 2)) ** 2,
        rng.random((rows, landmarks)) < 0.8,
        np.zeros(rows) if pairs_first else MISSING + rng.uniform(-1, 1, rows),
        np.inf,
        limits,
        pairs_first,
    )


def squared_and_logdet(problem, rows, marks):
    """Return νᵀ S⁻¹ ν and ln det S of some pairs, the dense way."""
    at = np.array([(2 * j, 2 * j + 1) for j in marks], dtype=int).ravel()
    S = problem.joint[np.ix_(at, at)] + np.diag(problem.variances[rows, marks].ravel())
    nu = problem.innovations[rows, marks].ravel()
    return nu @ np.linalg.solve(S, nu), np.linalg.slogdet(S)[1]


def all_assignments(problem):
    """Return every assignment as (cost, landmark of each reading), sorted."""
    rows = len(problem.feasible)
    options = [[UNPAIRED, *np.flatnonzero(row)] for row in problem.feasible]
    result = []
    for marks in product(*options):
        paired = [i for i in range(rows) if marks[i] != UNPAIRED]
        chosen = [marks[i] for i in paired]
        if len(set(chosen)) == len(chosen):
            squared, logdet = squared_and_logdet(problem, paired, chosen)
            if problem.pairs_first:
                result.append((-len(paired), squared, marks))
            else:
                unpaired = [i for i in range(rows) if marks[i] == UNPAIRED]
                left_out = problem.missing[unpaired].sum()
                result.append((squared + logdet + left_out, marks))
    return sorted(result)


def test_expected_readings_are_those_of_the_dense_equations():
    rng = np.random.default_rng(3)
    mean = rng.normal(scale=3.0, size=3 + 2 * 6)
    root = rng.normal(scale=0.15, size=(len(mean), len(mean)))
    P, slots = root @ root.T, np.array([4, 0, 5])
    expected, joint = predicted_readings(mean, P, slots)
    prediction = predict_measurement(mean[:3], mean[3:].reshape(-1, 2)[slots])
    H = np.zeros((6, len(mean)))
    for k, slot in enumerate(slots):
        H[2 * k : 2 * k + 2, :3] = prediction.jacobian_pose[k]
        H[2 * k : 2 * k + 2, 3 + 2 * slot : 5 + 2 * slot] = (
            prediction.jacobian_landmark[k]
        )
    np.testing.assert_allclose(expected, prediction.measurement, atol=1e-14)
    np.testing.assert_allclose(joint, H @ P @ H.T, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("seed", range(10))
def test_the_best_assignments_are_those_of_an_exhaustive_search(seed):
    rng = np.random.default_rng(seed)
    for _ in range(40):
        problem = random_problem(rng)
        found = solve(problem, most=5, nodes=10**6)
        expected = all_assignments(problem)[:5]
        assert found.is_complete
        np.testing.assert_allclose(found.costs, [c for c, _ in expected], rtol=1e-9)
        assert tuple(found.marks[0]) == tuple(expected[0][1])


def is_compatible(problem, marks):
    """Whether the pairs are jointly compatible at every level of the search.

    The reading with the fewest landmarks comes first, then the smallest innovation.
    """
    rows = [i for i in range(len(marks)) if marks[i] != UNPAIRED]
    options = problem.feasible.sum(axis=1)
    rows.sort(key=lambda i: (options[i], *problem.innovations[i, 0]))
    return all(
        squared_and_logdet(problem, rows[:k], [marks[i] for i in rows[:k]])[0]
        <= problem.limits[k]
        for k in range(1, len(rows) + 1)
    )


def test_compatibility_takes_most_pairs_and_then_the_nearest():
    rng = np.random.default_rng(0)
    for _ in range(100):
        problem = random_problem(rng, pairs_first=True)
        expected = next(
            a for a in all_assignments(problem) if is_compatible(problem, a[2])
        )
        found = solve(problem, nodes=10**6)
        assert tuple(found.marks[0]) == tuple(expected[2])


def test_the_order_of_the_scan_changes_nothing():
    rng = np.random.default_rng(1)
    for _ in range(100):
        problem = random_problem(rng)
        order = rng.permutation(len(problem.innovations))
        turned = problem._replace(
            innovations=problem.innovations[order],
            variances=problem.variances[order],
            feasible=problem.feasible[order],
            missing=problem.missing[order],
        )
        one, other = solve(problem), solve(turned)
        np.testing.assert_array_equal(one.marks[0][order], other.marks[0])
        assert one.costs[0] == other.costs[0]


def test_the_limit_of_nodes_returns_the_best_so_far_and_says_so():
    rng = np.random.default_rng(2)
    rows = landmarks = 12
    expected = np.column_stack([np.linspace(-0.3, 0.3, landmarks), np.full(12, 5.0)])
    problem = Problem(
        innovations_of(expected + rng.normal(scale=0.2, size=(rows, 2)), expected),
        0.2 * np.eye(2 * landmarks),
        np.full((rows, landmarks, 2), 0.04),
        np.ones((rows, landmarks), dtype=bool),
        np.full(rows, 2.0),
        25.0,
        np.full(rows + 1, np.inf),
        False,
    )
    few = solve(problem, nodes=50)
    many = solve(problem, nodes=20_000)
    assert not few.is_complete
    assert few.costs[0] >= many.costs[0]
    assert len(set(few.marks[0][few.marks[0] != UNPAIRED].tolist())) == int(
        (few.marks[0] != UNPAIRED).sum()
    )


@pytest.mark.parametrize("pairs_first", [False, True])
def test_a_pair_exactly_at_its_limits_is_accepted(pairs_first):
    nu, one = np.array([[[3.0, 0.0]]]), np.ones((1, 1), dtype=bool)
    given = nu, np.zeros((2, 2)), np.ones((1, 1, 2)), one, np.full(1, 99.0)
    at = Problem(*given, 9.0, np.array([np.inf, 9.0]), pairs_first)
    assert solve(at).marks.tolist() == [[0]]
    below = at._replace(gate=8.99), at._replace(limits=np.array([np.inf, 8.99]))
    assert [solve(each).marks.tolist() for each in below] == [[[UNPAIRED]]] * 2


@pytest.mark.parametrize("method", ["joint", "compatibility", "hypotheses"])
def test_a_scan_is_assigned_as_step_by_step_in_numpy(method):
    rng, policy = np.random.default_rng(5), LandmarkPolicy(association=method)
    noise, several, ambiguous = Noise(0.05, 0.2, 0.02, 0.1), 0, 0
    for _ in range(150):
        count, rows = rng.integers(0, 9), rng.integers(0, 11)
        mean = rng.normal(scale=3.0, size=3 + 2 * count)
        root = rng.normal(scale=rng.choice([0.05, 0.2]), size=(len(mean), len(mean)))
        view = MapView(mean, root @ root.T, tuple(range(count)))
        readings = rng.uniform((-3, 0.5), (3, 5), (rows, 2))
        density = rng.uniform(0.001, 2.0, rows)
        limits = np.full(rows + 1, np.inf)
        if method == "compatibility":
            tail = np.exp(-policy.pair_gate / 2)
            limits[1:] = chi2.isf(tail, 2 * np.arange(1, rows + 1))
        most = policy.branches if method == "hypotheses" else 1
        found = assign_scan(policy, view, readings, noise, density)
        costs, slots, explained = assign_plainly(
            policy, view, readings, noise, density, limits=limits, most=most
        )
        np.testing.assert_array_equal(found.explained, explained)
        np.testing.assert_array_equal(found.costs, costs)
        np.testing.assert_array_equal(found.slots, slots)
        several += len(costs) > 1
        ambiguous += sum((each == AMBIGUOUS).sum() for each in slots)
    assert several > 30 or method != "hypotheses"
    assert ambiguous > 10 or method == "compatibility"  # it pairs nearly all


@pytest.mark.parametrize("method", ["joint", "hypotheses"])
@pytest.mark.parametrize(("ceiling", "range_std"), [(np.inf, 0.9), (10.0, 0.1)])
def test_a_scan_with_one_landmark_for_each_reading_is_assigned_as_by_the_search(
    method, ceiling, range_std
):
    """It is settled without the search if no other assignment is of interest.

    This includes scans where leaving out a reading is cheap, but changes nothing.  Of
    scans that a search of one node cannot assign, many are settled, too.
    """
    rng = np.random.default_rng(8)
    std = np.array([0.03, range_std])
    policy, noise = LandmarkPolicy(association=method), Noise(*std, 0.02, 0.01)
    most = policy.branches if method == "hypotheses" else 1
    single, others, cheap, settled, unpaired = 0, 0, 0, 0, 0
    for _ in range(400):
        count = rng.integers(1, 9)
        mean = rng.normal(scale=6.0, size=3 + 2 * count)
        root = rng.normal(
            scale=rng.choice([0.001, 0.01, 0.05]), size=(len(mean), len(mean))
        )
        view = MapView(mean, root @ root.T, tuple(range(count)))
        expected = predict_measurement(mean[:3], view.landmarks).measurement
        scale = rng.choice([1.0, 3.5]) * std
        seen = rng.permutation(count)[: rng.integers(1, count + 1)]
        readings = expected[seen] + rng.normal(size=(len(seen), 2)) * scale
        if far := rng.integers(2):  # from all landmarks
            seen, readings = np.append(seen, NEW), np.vstack([readings, (0.0, 99.0)])
        density = np.exp(rng.uniform(-12, 0, len(seen)))
        limits = np.full(len(seen) + 1, np.inf)
        scan = policy, view, readings, noise, density
        found = assign_scan(*scan, ceiling=ceiling)
        costs, slots, explained = assign_plainly(
            *scan, limits=limits, most=most, ceiling=ceiling
        )
        np.testing.assert_array_equal(found.explained, explained)
        np.testing.assert_array_equal(found.costs, costs)
        np.testing.assert_array_equal(found.slots, slots)
        hasty = replace(policy, search_nodes=1), *scan[1:]
        is_settled = len(slots) > 1 and np.array_equal(
            assign_scan(*hasty, ceiling=ceiling).slots, slots
        )
        settled, unpaired = settled + is_settled, unpaired + (is_settled and far > 0)
        nu = (readings - expected[seen]) / std  # the least σ of a reading
        left_out = -2 * np.log(2 * np.pi * density * std.prod()) - (nu**2).sum(axis=1)
        is_single = len(slots) == 1 and slots[0].tolist() == seen.tolist()
        single, others = single + is_single, others + (not is_single)
        cheap += is_single and bool((left_out < 10.0).any())
    assert single > 30
    assert others > 30
    assert most == 1 or min(settled, unpaired) > 5
    assert cheap > 5 or most == 1 or ceiling < np.inf


@pytest.mark.parametrize("std", [(0.02, 0.0), (0.0, 0.05), (0.02, 1e-6)])
def test_an_exact_reading_of_an_uncertain_landmark_is_settled_by_the_search(std):
    """Its innovation and covariance after the pair are rounding errors."""
    rng, policy = np.random.default_rng(2), LandmarkPolicy(association="hypotheses")
    most, limits, several = policy.branches, np.full(2, np.inf), 0
    for _ in range(40):
        mean = np.append(np.zeros(3), rng.uniform(2, 8, 2) * rng.choice([-1, 1], 2))
        root = rng.normal(size=(5, 5)) * np.array([[0.3, 0.3, 0.1, 0.3, 0.3]]).T
        view = MapView(mean, root @ root.T, (0,))
        expected = predict_measurement(mean[:3], view.landmarks).measurement
        readings = expected + rng.normal(size=(1, 2)) * (0.1, 0.5)
        for density in 10 ** np.arange(-4.0, 1.0, 0.25):
            scan = policy, view, readings, Noise(*std), np.array([density])
            found = assign_scan(*scan)
            costs, slots, _ = assign_plainly(*scan, limits=limits, most=most)
            np.testing.assert_array_equal(found.costs, costs)
            np.testing.assert_array_equal(found.slots, slots)
            several += len(slots) > 1
    assert several > 20


def test_readings_that_contradict_each_other_are_not_settled():
    """Each fits its landmark if the heading is wrong, by .25 rad to one side."""
    policy, noise = LandmarkPolicy(association="joint"), Noise(0.03, 0.1)
    mean, spread = np.array([0, 0, 0, 5, 0, 0, 5.0]), np.full(7, 1e-4)
    spread[2] = 0.04
    view = MapView(mean, np.diag(spread), (0, 1))
    readings = np.array([(0.25, 5.0), (np.pi / 2 - 0.25, 5.0)])
    scan = policy, view, readings, noise, np.full(2, 1e-30)
    found = assign_scan(*scan)
    costs, slots, _ = assign_plainly(*scan, limits=np.full(3, np.inf), most=1)
    np.testing.assert_array_equal(found.costs, costs)
    np.testing.assert_array_equal(found.slots, slots)
    assert (found.slots < 0).any()


@pytest.mark.parametrize("few", [1, 4])
def test_a_reading_that_the_others_contradict_is_assigned_as_by_the_search(few):
    """Alone it is near its landmark; given the others, it is farther or costs more."""
    policy, noise, found = (
        LandmarkPolicy(association="hypotheses"),
        Noise(0.03, 0.1),
        [],
    )
    mean = np.array([0, 0, 0, *np.ravel([(4.0 + k, 0.0) for k in range(few + 1)])])
    for v, a, b in product((0.01, 0.03, 0.06), np.arange(2.6, 3.9, 0.1), (1.0, 1.7)):
        view = MapView(
            mean,
            np.diag(1e-9 + v * 0.03**2 * (np.arange(len(mean)) == 2)),
            range(few + 1),
        )
        for sign, more, rest in product((-1, 1), (-0.1, 0.05, 0.2, 4.0), (4.0, 30.0)):
            nu = sign * np.array([a, *np.full(few, -b)])
            readings = np.column_stack([0.03 * nu, mean[3::2]])
            # The cost of the innovation alone, plus ``more`` or ``rest``.
            left_out = np.log((1 + v) * 9e-6) + nu**2 / (1 + v) + [more, *[rest] * few]
            density = np.exp(-left_out / 2) / (2 * np.pi)
            scan = policy, view, readings, noise, density
            limits = np.full(few + 2, np.inf)
            costs, slots, _ = assign_plainly(*scan, limits=limits, most=policy.branches)
            assigned = assign_scan(*scan)
            np.testing.assert_array_equal(assigned.costs, costs)
            np.testing.assert_array_equal(assigned.slots, slots)
            found.append(len(slots) == 1 and min(slots[0]) >= 0)
    assert 0.1 < np.mean(found) < 0.9


def test_unpaired_readings_are_compared_with_free_landmarks_given_the_pairs():
    rng = np.random.default_rng(3)
    for _ in range(50):
        problem = random_problem(rng)
        found = solve(problem)
        marks = found.marks[0]
        paired = np.flatnonzero(marks != UNPAIRED)
        for row in np.flatnonzero(marks == UNPAIRED):
            before = squared_and_logdet(problem, paired, marks[paired])[0]
            free = set(range(problem.feasible.shape[1])) - set(marks[paired].tolist())
            least = min(
                (
                    conditional_distance(problem, paired, marks[paired], row, j)
                    for j in free
                ),
                default=np.inf,
            )
            assert found.distances[0, row] == pytest.approx(least, rel=1e-8)
            assert before >= 0


def conditional_distance(problem, rows, marks, row, mark):
    """Return νᵀ S⁻¹ ν of one more pair given others, the dense way."""
    at = np.array([(2 * j, 2 * j + 1) for j in marks], dtype=int).ravel()
    C = problem.joint
    own, cross = (
        C[2 * mark : 2 * mark + 2, 2 * mark : 2 * mark + 2],
        C[at][:, 2 * mark : 2 * mark + 2],
    )
    nu = problem.innovations[row, mark]
    Q = np.diag(problem.variances[row, mark])
    S = own + Q
    if len(rows):
        whole = C[np.ix_(at, at)] + np.diag(problem.variances[rows, marks].ravel())
        gain = np.linalg.solve(whole, cross).T
        nu = nu - gain @ problem.innovations[rows, marks].ravel()
        S = S - gain @ cross
    is_sure = np.linalg.det(S) <= SURE * np.linalg.det(Q)
    return float(nu @ np.linalg.solve(S, nu)) if is_sure else np.inf


def posterior(P, H, problem, rows, marks):
    """Return the shift of the mean and the covariance after some pairs, dense."""
    at = np.array([(2 * j, 2 * j + 1) for j in marks], dtype=int).ravel()
    S = problem.joint[np.ix_(at, at)] + np.diag(problem.variances[rows, marks].ravel())
    gain = P @ H[at].T @ np.linalg.inv(S)
    return gain @ problem.innovations[rows, marks].ravel(), P - gain @ H[at] @ P


def linear_problem(rng, rows=4, landmarks=4):
    """Return a state's covariance P, H of its readings, and their problem."""
    root = rng.normal(scale=0.2, size=(11, 11))
    P, H = root @ root.T, rng.normal(size=(2 * landmarks, 11))
    problem = Problem(
        rng.normal(scale=0.5, size=(rows, landmarks, 2)),
        H @ P @ H.T,
        rng.uniform(0.1, 0.5, (rows, landmarks, 2)) ** 2,
        np.ones((rows, landmarks), dtype=bool),
        np.zeros(rows),
        np.inf,
        np.full(rows + 1, np.inf),
        False,
    )
    return P, H, problem


def test_the_bound_on_the_change_by_some_pairs_holds_and_is_not_far_off():
    rng = np.random.default_rng(11)
    ratios = []
    for count in (1, 1, 1, 2) * 50:
        P, H, problem = linear_problem(rng)
        marks = rng.permutation(4)
        fewer = marks.copy()
        fewer[:count] = UNPAIRED
        with_all = posterior(P, H, problem, np.arange(4), marks)
        without = posterior(P, H, problem, np.arange(count, 4), marks[count:])
        variances, others = np.diag(with_all[1]), np.diag(without[1])
        squared = (with_all[0] - without[0]) ** 2 + others - variances
        change = np.sqrt((squared / variances).max())
        bound = largest_change(problem, marks, fewer)
        assert change <= bound * (1 + 1e-9)
        ratios.append(change / bound)
    assert max(ratios) > 0.5


def test_the_bound_on_the_change_by_one_pair_is_that_of_its_equation():
    _, _, problem = linear_problem(np.random.default_rng(3), rows=1, landmarks=1)
    nu, Q = problem.innovations[0, 0], np.diag(problem.variances[0, 0])
    S = problem.joint + Q
    left = np.linalg.eigvals(np.linalg.solve(S, Q)).real.min()  # 1 − λ
    shift = np.sqrt((1 - left) * (nu @ np.linalg.solve(S, nu)) / left)
    found = largest_change(problem, np.array([0]), np.array([UNPAIRED]))
    assert found == pytest.approx(np.sqrt(shift**2 + 1 / left - 1))


def test_only_pairs_that_are_left_out_have_a_bound():
    *_, problem = linear_problem(np.random.default_rng(2), rows=2, landmarks=3)
    marks, other = np.array([0, 1]), np.array([0, 2])
    assert largest_change(problem, marks, marks) == 0
    assert largest_change(problem, marks, other) == np.inf
    assert largest_change(problem, np.array([0, UNPAIRED]), marks) == np.inf
