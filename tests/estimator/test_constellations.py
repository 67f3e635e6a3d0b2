"""Recognition of a place by its constellation, against searches over all matches."""

from itertools import combinations, permutations

import networkx as nx
import numpy as np
import pytest
from scipy.stats import chi2

from slamgym.estimator.association import constellations
from slamgym.estimator.association import constellations as same_place
from slamgym.estimator.association.constellations import (
    Constellations,
    Match,
    TwoPlaces,
    match_constellations,
)
from slamgym.estimator.kernels.assignment_search import compare_pairs, search_clique
from slamgym.estimator.models.rigid_motion import invariant_error

STD = 0.05
GROUP = np.array([(0, 0), (4, 1), (1, 5), (6, 6), (9, 2), (3, 9), (8, 9)], dtype=float)


def turned(points, angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([(cos, sin), (-sin, cos)])


def shifted(points, x, y=0.0):
    return points + np.array([x, y])


def two_places(a, b, drift=3.0, largest_turn=np.pi):
    """Independent errors of STD, and a common one of all local landmarks."""
    m, size = len(a), len(a) + len(b)
    covariance = STD**2 * np.eye(2 * size)
    covariance[: 2 * m, : 2 * m] += drift**2 * np.kron(np.ones((m, m)), np.eye(2))
    return TwoPlaces(a, b, covariance, largest_turn)


def matched(a, b, rules=None, feasible=None, **changes):
    may = np.full((len(a), len(b)), True) if feasible is None else feasible
    match = match_constellations(
        two_places(a, b, **changes), may, rules or Constellations(least=5)
    )
    return match and dict(zip(match.local.tolist(), match.older.tolist(), strict=True))


def noisy(points, seed=0):
    return points + STD * np.random.default_rng(seed).standard_normal(points.shape)


# --- the search ---


def random_graph(seed):
    rng = np.random.default_rng(seed)
    pairs = np.argwhere(rng.random((6, 7)) < 0.6)
    agree = np.triu(rng.random((len(pairs), len(pairs))) < 0.5, 1)
    agree &= (pairs[:, None] != pairs[None]).all(axis=2)
    return pairs, agree | agree.T


def test_the_clique_is_as_large_as_that_of_networkx():
    for seed in range(40):
        pairs, agree = random_graph(seed)
        clique = np.zeros(7, dtype=np.int64)
        size, visited = search_clique(pairs, agree, 0, 100_000, clique)
        graph = nx.from_numpy_array(agree)
        assert size == max(map(len, nx.find_cliques(graph)))
        assert visited < 100_000
        assert all(agree[s, t] for s, t in combinations(clique[:size], 2))


def test_the_search_finds_no_clique_that_is_not_larger_than_wanted():
    pairs, agree = random_graph(0)
    clique = np.zeros(7, dtype=np.int64)
    size, _ = search_clique(pairs, agree, 0, 100_000, clique)
    assert search_clique(pairs, agree, size - 1, 100_000, clique)[0] == size
    assert search_clique(pairs, agree, size, 100_000, clique)[0] == 0


def test_the_search_stops_at_its_limit():
    pairs, agree = random_graph(0)
    clique = np.zeros(7, dtype=np.int64)
    assert search_clique(pairs, agree, 0, 3, clique)[1] == 3


def test_pairs_agree_where_distance_and_direction_do():
    rng = np.random.default_rng(3)
    a, b = rng.uniform(0, 6, (4, 2)), rng.uniform(0, 6, (5, 2))
    pairs = np.argwhere(np.full((4, 5), True))
    tables = constellations.tables(two_places(a, b))
    agree = np.zeros((20, 20), dtype=np.bool_)
    compare_pairs(pairs, *tables, 400.0, 1.0, agree)
    for s, (i, p) in enumerate(pairs):
        for t, (j, q) in enumerate(pairs):
            one, other = a[j] - a[i], b[q] - b[p]
            gap = np.linalg.norm(one) - np.linalg.norm(other)
            turn = np.angle(complex(*other) * np.conj(complex(*one)))
            close = gap**2 <= 400.0 * 4 * STD**2 and abs(turn) <= 1.0
            assert agree[s, t] == (i != j and p != q and close)
    assert 20 < agree.sum() < 200


def test_a_table_holds_lengths_their_variances_and_directions():
    rng = np.random.default_rng(4)
    points, root = rng.uniform(0, 6, (4, 2)), rng.standard_normal((16, 16))
    P = root @ root.T
    places = TwoPlaces(points, points + 1.0, P, 1.0)
    parts = P[:8, :8], P[8:, 8:]
    for table, part in zip(constellations.tables(places), parts, strict=True):
        for i, j in permutations(range(4), 2):
            d = points[j] - points[i]
            unit, H = d / np.linalg.norm(d), np.zeros(8)
            H[2 * j : 2 * j + 2], H[2 * i : 2 * i + 2] = unit, -unit
            expected = np.linalg.norm(d), H @ part @ H, np.arctan2(*d[::-1])
            np.testing.assert_allclose(table[:, i, j], expected, rtol=1e-9)


def test_a_rival_may_match_nearly_as_many_landmarks_as_the_first(monkeypatch):
    floors, search = [], constellations.largest_clique

    def noted(pairs, agree, floor, nodes):
        floors.append(floor)
        return search(pairs, agree, floor, nodes)

    monkeypatch.setattr(constellations, "largest_clique", noted)
    here = np.concatenate([GROUP, [(-3.0, 4.0)]])
    places, may = two_places(noisy(here), here), np.full((8, 8), True)
    for margin, rival in ((1, 6), (3, 5), (9, 2)):
        rules = Constellations(least=5, margin=margin)
        found = constellations.agreeing_pairs(places, may, rules, most=2)
        assert floors[-2:] == [4, rival]
        assert len(found[0].local) == 8
    twice = np.concatenate([here, shifted(here, 40.0)])
    places, may = two_places(noisy(here), twice, drift=30.0), np.full((8, 16), True)
    for most in (1, 2):
        found = constellations.agreeing_pairs(places, may, rules, most)
        assert [len(match.older) for match in found] == [8] * most
    few = Constellations(least=5, search_nodes=1)
    ((local, older),) = constellations.agreeing_pairs(places, may, few, most=2)
    assert (len(local), len(older)) == (0, 0)  # the search has reached its limit


def largest_by_trying_all(a, b, gate):
    """The largest number of landmarks whose distances agree, over all matches."""
    d, e = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in (a, b))
    for size in range(len(a), 0, -1):
        for some in combinations(range(len(a)), size):
            for others in permutations(range(len(b)), size):
                difference = d[np.ix_(some, some)] - e[np.ix_(others, others)]
                if (difference**2 <= gate).all():
                    return size
    return 0


def test_the_largest_constellation_is_that_of_a_search_over_all_matches():
    sizes = set()
    for seed in range(15):
        rng = np.random.default_rng(seed)
        b = rng.uniform(0, 8, (6, 2))
        some = rng.permutation(6)[: rng.integers(2, 5)]
        a = np.concatenate(
            [noisy(turned(b[some], 0.7), seed), rng.uniform(0, 8, (1, 2))]
        )
        places = two_places(a, b)
        pairs = np.argwhere(np.full((len(a), 6), True))
        agree = np.zeros((len(pairs), len(pairs)), dtype=np.bool_)
        tables = constellations.tables(places)
        gate = constellations.DISTANCE_GATE
        compare_pairs(pairs, *tables, gate, np.pi, agree)
        clique, is_complete = constellations.largest_clique(pairs, agree, 0, 100_000)
        assert is_complete
        assert len(clique) == largest_by_trying_all(a, b, gate * 4 * STD**2)
        sizes.add(len(clique))
    assert len(sizes) > 1


# --- what is recognised ---


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.0])
def test_a_turned_and_shifted_place_is_recognised(angle):
    others = np.array([(20.0, 3.0), (22.0, 8.0)])
    older = np.concatenate([others, GROUP])
    local = noisy(shifted(turned(GROUP[::-1], angle), 2.0, -1.0))
    assert matched(local, older, drift=30.0) == {i: 8 - i for i in range(7)}


ALL = {i: i for i in range(7)}
SIX_LEAST = Constellations(least=6, margin=1)
FEW_NODES = Constellations(least=5, search_nodes=20)
NOT_THE_THIRD = np.arange(7)[:, None].repeat(7, axis=1) != 2


@pytest.mark.parametrize(
    ("local", "changes", "expected"),
    [
        (GROUP, {}, ALL),
        (GROUP * (-1.0, 1.0), {"drift": 30.0}, None),  # mirrored
        (shifted(GROUP, 7.0), {"drift": 3.0}, ALL),
        (shifted(GROUP, 20.0), {"drift": 3.0}, None),  # beyond the drift
        (GROUP, {"feasible": NOT_THE_THIRD}, ALL),  # added once others are matched
        (GROUP[:6], {"rules": SIX_LEAST}, {i: i for i in range(6)}),
        (GROUP[:5], {"rules": SIX_LEAST}, None),  # too few
        (GROUP, {"rules": FEW_NODES}, None),  # the search has a limit
    ],
)
def test_a_group_is_recognised_within_the_rules(local, changes, expected):
    assert matched(noisy(local), GROUP, **changes) == expected


def test_a_place_seen_twice_before_is_not_recognised():
    twice = np.concatenate([GROUP, shifted(turned(GROUP, 0.5), 14.0)])
    assert matched(noisy(GROUP), GROUP, drift=30.0) is not None
    assert matched(noisy(GROUP), twice, drift=30.0) is None


def test_more_landmarks_decide_between_places_that_look_alike():
    around = np.array([(-3.0, 4.0), (-4.0, -2.0), (2.0, -4.0)])
    here = np.concatenate([GROUP, around])
    twice = np.concatenate([here, shifted(GROUP, 16.0)])
    assert matched(noisy(here), twice, drift=30.0) == {i: i for i in range(10)}


def test_a_symmetric_place_is_not_recognised():
    hexagon = 5 * np.array([(np.cos(t), np.sin(t)) for t in np.arange(6) * np.pi / 3])
    assert matched(noisy(hexagon), hexagon) is None
    assert matched(noisy(hexagon), hexagon, largest_turn=0.3) is not None


def test_a_regular_grid_is_not_recognised():
    grid = 3.0 * np.argwhere(np.full((5, 6), True))
    assert matched(noisy(grid), grid) is None
    near = np.linalg.norm(grid[:, None] - grid, axis=2) < 1.5
    assert matched(noisy(grid), grid, feasible=near) == {i: i for i in range(30)}


def test_landmarks_without_a_partner_in_the_middle_refuse_a_match():
    rng = np.random.default_rng(1)
    others = rng.uniform(1, 8, (7, 2))
    assert matched(noisy(GROUP), np.concatenate([GROUP, others])) is None
    far = np.concatenate([GROUP, shifted(others, 30.0)])
    assert matched(noisy(GROUP), far) is not None


def test_the_order_of_the_landmarks_does_not_matter():
    order = np.random.default_rng(0).permutation(7)
    local = noisy(GROUP)
    found = matched(local[order], GROUP)
    assert found == dict(enumerate(order.tolist()))


# --- the statistics ---


def random_places(seed):
    """Return two maps with correlated errors, the local one turned, and a match."""
    rng = np.random.default_rng(seed)
    older = rng.uniform(0, 9, (9, 2))
    again = np.array([4, 0, 7, 2, 8, 1])  # the partners of the local landmarks
    local = shifted(turned(older[again], 0.4), 3.0, -1.0)
    local = np.concatenate([local, rng.uniform(0, 9, (2, 2))])
    root = 0.02 * rng.standard_normal((34, 34))
    drift = np.zeros((34, 2))
    drift[0:16:2, 0] = drift[1:16:2, 1] = 2.0
    places = TwoPlaces(local, older, root @ root.T + drift @ drift.T, np.pi)
    places.local[:] += rng.multivariate_normal(np.zeros(34), root @ root.T)[
        :16
    ].reshape(8, 2)
    return places, Match(np.array([0, 2, 3, 5]), again[[0, 2, 3, 5]])


def plain_offsets(places, match, phi):
    """Return the offsets r of matched landmarks, and their covariance, by entries."""
    V = (np.exp(-1j * phi) - 1) / (-1j * phi)
    r, H = [], np.zeros((2 * len(match.local), 34))
    for k, (i, p) in enumerate(zip(*match, strict=True)):
        offset = complex(*(places.local[i] - places.older[p])) / V
        r += [offset.real, offset.imag]
        H[2 * k : 2 * k + 2, 16 + 2 * p : 18 + 2 * p] = np.eye(2)
        H[2 * k : 2 * k + 2, 2 * i : 2 * i + 2] = -np.eye(2)
    return np.array(r), H @ places.covariance @ H.T


@pytest.mark.parametrize("seed", range(3))
def test_a_match_moves_the_local_map_onto_its_partners(seed):
    places, match = random_places(seed)
    exact = places._replace(local=shifted(turned(places.older, 0.4), 3.0, -1.0))
    some = Match(np.array([5, 1, 2]), np.array([5, 1, 2]))
    assert same_place.turn_between(exact, some) == pytest.approx(-0.4)
    found = same_place.moved(exact, some, exact.local)
    np.testing.assert_allclose(found, exact.older, atol=1e-12)
    away = np.linalg.norm(exact.older[:, None] - exact.older, axis=2)
    np.testing.assert_allclose(same_place.moved_gaps(exact, some), away, atol=1e-12)
    r, S = plain_offsets(places, match, same_place.turn_between(places, match))
    b = places.older[match.older]
    G = np.zeros((8, 3))
    G[0::2, 0] = G[1::2, 1] = 1.0
    G[0::2, 2], G[1::2, 2] = (b.mean(axis=0) - b).T[1], (b - b.mean(axis=0)).T[0]
    W = np.linalg.inv(S)

    def left(modes):
        fit = np.linalg.solve(modes.T @ W @ modes, modes.T @ W @ r)
        return (r - modes @ fit) @ W @ (r - modes @ fit)

    shape, displacement = left(G), left(G[:, 2:]) - left(G)
    expected = shape, displacement
    np.testing.assert_allclose(same_place.misfit(places, match), expected, rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_pairs_are_added_that_fit_given_the_matched_ones(seed, monkeypatch):
    places, match = random_places(seed)
    phi = same_place.turn_between(places, match)
    gaps = same_place.moved_gaps(places, match)
    left = [i for i in range(8) if i not in match.local]
    free = [p for p in range(9) if p not in match.older]
    added, squares = [], []
    for i in left:
        p = min(free, key=lambda p: gaps[i, p])
        if i != min(left, key=lambda i: gaps[i, p]):
            continue
        r, S = plain_offsets(places, Match([*match.local, i], [*match.older, p]), phi)
        gain = S[8:, :8] @ np.linalg.inv(S[:8, :8])
        nu, C = r[8:] - gain @ r[:8], S[8:, 8:] - gain @ S[:8, 8:]
        squares.append(nu @ np.linalg.solve(C, nu))
        added.append((i, p))
    gate = np.median(squares)  # half of them pass
    monkeypatch.setattr(same_place, "PAIR_GATE", 1.0001 * gate)
    found = same_place.extended(places, match)
    kept = [pair for pair, x in zip(added, squares, strict=True) if x <= gate]
    expected = [*zip(*match, strict=True), *kept]
    assert list(zip(*(each.tolist() for each in found), strict=True)) == expected
    assert len(match.local) < len(expected) < len(match.local) + len(added)


def test_a_match_is_plausible_up_to_the_tail_of_each_test(monkeypatch):
    match = Match(np.arange(6), np.arange(6))
    limits = np.array([chi2.isf(1e-4, 2 * 6 - 3), chi2.isf(1e-4, 2)])
    for excess in ((0, 0), (1e-6, 0), (0, 1e-6)):
        found = tuple(limits - 1e-9 + excess)
        monkeypatch.setattr(same_place, "misfit", lambda *_, found=found: found)
        assert same_place.is_plausible(None, match) == (not any(excess))


def test_the_tests_have_the_chi_square_of_their_degrees_at_any_heading_error():
    """Estimates are drawn from the invariant error, whose heading has σ = 0.5 rad."""
    rng = np.random.default_rng(0)
    k = len(GROUP)
    root = 0.05 * rng.standard_normal((4 * k + 3, 4 * k + 3))
    P = root @ root.T
    drift = np.zeros((3, 4 * k + 3))
    drift[0, 3 : 3 + 2 * k : 2] = drift[1, 4 : 4 + 2 * k : 2] = 2.0
    P += drift.T @ drift
    P[2, 2] += 0.25
    truth = np.concatenate([[1.0, 2.0, 0.0], GROUP.ravel(), GROUP.ravel()])
    chi = []
    for _ in range(250):
        xi = rng.multivariate_normal(np.zeros(4 * k + 3), P)
        mean = estimate_with(truth, xi)
        np.testing.assert_allclose(invariant_error(truth, mean), xi, atol=1e-9)
        points = mean[3:].reshape(-1, 2)
        places = TwoPlaces(points[:k], points[k:], P[3:, 3:], np.pi)
        every = np.arange(k)
        chi.append(same_place.misfit(places, Match(every, every)))
    shape, displacement = np.mean(chi, axis=0)
    assert shape == pytest.approx(2 * k - 3, rel=0.1)
    assert displacement == pytest.approx(2, rel=0.2)


def estimate_with(truth, xi):
    """The estimate χ̂ of which the truth has the error ξ: χ̂ = exp(−ξ) χ."""
    t = -xi[2]
    V = (np.exp(1j * t) - 1) / (1j * t)
    points = np.delete(truth, 2).reshape(-1, 2) @ (1, 1j)
    moves = np.delete(xi, 2).reshape(-1, 2) @ (1, 1j)
    moved = np.exp(1j * t) * points - V * moves
    flat = np.column_stack([moved.real, moved.imag]).ravel()
    return np.insert(flat, 2, truth[2] + t)


@pytest.mark.parametrize(
    ("field", "value"),
    [("least", 2), ("margin", 0), ("lost_std", 0.0), ("search_nodes", 0)],
)
def test_bad_rules_are_refused_by_name(field, value):
    with pytest.raises(ValueError, match=f"constellations.{field}"):
        Constellations(**{field: value})


@pytest.mark.parametrize("others", [0, 1])
def test_a_covariance_without_rank_recognises_no_place(others):
    a = np.vstack([shifted(GROUP, 2.0), np.full((others, 2), 40.0)])
    b = np.vstack([GROUP, np.full((others, 2), -30.0)])
    places = two_places(a, b)
    k = len(GROUP)
    may = np.eye(len(a), dtype=bool) & (np.arange(len(a)) < k)
    rules = Constellations(least=5)
    assert len(match_constellations(places, may, rules).local) == k
    certain = places._replace(covariance=np.zeros_like(places.covariance))
    same = Match(np.arange(k), np.arange(k))
    assert constellations.misfit(certain, same) == (np.inf, np.inf)
    assert match_constellations(certain, may, rules) is None


@pytest.mark.parametrize("crowded", [None, "far", "local", "older"])
@pytest.mark.parametrize("count", [2, 3])
def test_a_place_is_filled_where_neither_map_has_many_landmarks_more(crowded, count):
    """Four of six landmarks have a partner, or four of seven."""
    square = np.array([[2.0, 2.0], [-2.0, 2.0], [-2.0, -2.0], [2.0, -2.0]])
    more = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])[:count]
    local, older = square, square
    if crowded in ("local", "far"):
        local = np.concatenate([square, more - [9.0 * (crowded == "far"), 0.0]])
    if crowded == "older":
        older = np.concatenate([square, more])
    size = 2 * (len(local) + len(older))
    places = TwoPlaces(shifted(local, 10.0, -3.0), older, np.eye(size), 1.0)
    match = Match(np.arange(4), np.arange(4))
    is_filled = crowded in (None, "far") or count == 2
    assert same_place.is_filled(places, match) == is_filled
    five = np.concatenate([square[:3], [(-0.6, 0.6), (-0.7, 0.7)]])
    edge = TwoPlaces(five, five, np.eye(20), 1.0)  # three of five are enough
    assert same_place.is_filled(edge, Match(np.arange(3), np.arange(3)))
