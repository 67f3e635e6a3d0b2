import math

import numpy as np
import pytest

from slamgym.envs.robot import UnicycleBody, wall_distances

SKIN = 1e-6
RADIUS = 0.3
ARENA = [
    (-4.0, -4.0, 4.0, -4.0),
    (4.0, -4.0, 4.0, 4.0),
    (4.0, 4.0, -4.0, 4.0),
    (-4.0, 4.0, -4.0, -4.0),
    (-2.0, -1.0, 2.0, 1.5),
    (1.0, -2.5, 1.2, -1.0),
    (-3.0, 2.0, -1.5, 2.8),
    (2.5, 2.5, 2.5, 3.0),
    (-2.5, -3.0, -1.0, -2.0),
]


def distance_to_wall(point, wall):
    """Distance of a point to a segment, by projection."""
    a, b = complex(*wall[:2]), complex(*wall[2:])
    share = ((point - a) * (b - a).conjugate()).real / abs(b - a) ** 2
    return abs(point - (a + min(max(share, 0.0), 1.0) * (b - a)))


def test_distances_from_walls_are_those_of_a_projection():
    rng = np.random.default_rng(7)
    points = rng.uniform(-6, 6, 200) + 1j * rng.uniform(-6, 6, 200)
    a, b = np.array(ARENA).view(np.complex128).T
    expected = [[distance_to_wall(point, wall) for wall in ARENA] for point in points]
    np.testing.assert_allclose(wall_distances(points, a, b - a), expected, atol=1e-12)


def clearance(body, walls):
    x, y, _ = body.pose
    return min(distance_to_wall(complex(x, y), wall) for wall in walls) - RADIUS


def first_contact(start, move, wall):
    """Share of `move` at which a disc first touches a segment, in closed form; or 1."""
    a, b = complex(*wall[:2]), complex(*wall[2:])
    along = (b - a) / abs(b - a)
    shares = []
    for end in (a, b):  # |start + t move - end| = RADIUS, the smaller root
        gap = start - end
        half = (gap * move.conjugate()).real
        root = half**2 - abs(move) ** 2 * (abs(gap) ** 2 - RADIUS**2)
        if root >= 0 and half < 0:
            shares.append((-half - math.sqrt(root)) / abs(move) ** 2)
    height, climb = ((z / along).imag for z in (start - a, move))
    if height * climb < 0:  # towards one of the two long sides of the inflated wall
        share = (abs(height) - RADIUS) / abs(climb)
        foot = ((start + share * move - a) / along).real
        if 0 <= foot <= abs(b - a):
            shares.append(share)
    return min((share for share in shares if 0 <= share <= 1), default=1.0)


def test_a_step_is_the_turn_last_model_to_the_last_bit():
    rng = np.random.default_rng(0)
    body = UnicycleBody(RADIUS)
    body.place((0.3, -0.2, 0.5))
    x, y, theta = 0.3, -0.2, 0.5
    for d, alpha, ex, ey, ea in rng.normal(size=(5000, 5)).tolist():
        cos, sin = np.cos(theta), np.sin(theta)
        x += (d + ex) * cos - ey * sin
        y += (d + ex) * sin + ey * cos
        theta += alpha + ea
        assert body.drive((d, alpha), (ex, ey, ea)) == 1.0
        assert body.pose.tolist() == [x, y, theta]


def test_the_frame_is_that_of_the_pose():
    body = UnicycleBody(RADIUS)
    body.drive((1.0, 2.0))
    body.drive((0.5, 0.1), (0.0, 0.2, 0.0))
    x, y, theta = body.pose
    assert body.frame[:, 0].tolist() == [x, y, theta, np.cos(theta), np.sin(theta)]


def test_the_robot_stops_a_skin_before_a_wall_and_says_how_far_it_came():
    body = UnicycleBody(RADIUS, [(2.0, -1.0, 2.0, 1.0)])
    share = body.drive((4.0, 0.7))
    np.testing.assert_allclose(body.pose, [2.0 - RADIUS - SKIN, 0.0, 0.7], atol=1e-12)
    assert share == pytest.approx(body.pose[0] / 4.0)


def test_a_far_wall_does_not_hide_contact_with_a_near_one():
    walls = [(2.0, 0.2, 2.0, 3.0), (9.0, -3.0, 9.0, 3.0)]
    body = UnicycleBody(RADIUS, walls)
    assert body.drive((4.0, 0.0)) < 0.5
    assert clearance(body, walls) >= 0.0


@pytest.mark.parametrize("side", [-1, 1])
def test_the_round_end_of_a_wall_is_met_from_the_side(side):
    wall = (2.0, 0.0, 6.0, 0.0)
    body = UnicycleBody(RADIUS, [wall])
    body.place((0.0, side * 0.2, -side * 0.05))
    share, move = body.drive((4.0, 0.0)), 4 * np.exp(-0.05j * side)
    expected = first_contact(0.2j * side, move, wall)
    assert share == pytest.approx(expected, abs=1e-6)
    assert share < 0.5


def test_at_a_wall_the_robot_can_turn_and_leave():
    body = UnicycleBody(RADIUS, [(2.0, -1.0, 2.0, 1.0)])
    body.drive((4.0, 0.0))
    stopped = body.pose
    assert body.drive((1.0, np.pi)) == 0.0
    np.testing.assert_array_equal(body.pose, stopped + np.array([0, 0, np.pi]))
    assert body.drive((1.0, 0.0)) == 1.0


@pytest.mark.parametrize(("x", "free"), [(1.9, -1.0), (2.1, 1.0)])
def test_a_robot_placed_inside_a_wall_can_only_leave(x, free):
    body = UnicycleBody(RADIUS, [(2.0, -1.0, 2.0, 1.0)])
    body.place((x, 0.0, 0.0))
    assert body.drive((-free, 0.0)) == 0.0
    assert body.drive((free, 0.0)) == 1.0


def test_noise_cannot_push_the_robot_through_a_wall():
    body = UnicycleBody(RADIUS, [(-1.0, 1.0, 1.0, 1.0)])
    assert body.drive((0.0, 0.0), (0.0, 5.0, 0.0)) < 1.0
    assert body.pose[1] == pytest.approx(1.0 - RADIUS - SKIN)


def test_random_driving_agrees_with_a_closed_form_and_never_touches_a_wall():
    rng = np.random.default_rng(1)
    body = UnicycleBody(RADIUS, ARENA)
    body.place((-3.0, 0.0, 0.3))
    hits = 0
    for d, alpha in rng.normal([0.3, 0.0], [0.4, 0.8], size=(4000, 2)).tolist():
        start, move = complex(*body.pose[:2]), d * np.exp(1j * body.pose[2])
        share = body.drive((d, alpha))
        contact = min(first_contact(start, move, wall) for wall in ARENA)
        assert share <= contact + 1e-9
        # the skin is measured across the wall, so a glancing contact stops earlier
        ends = start + share * move, start + contact * move
        gaps = [min(distance_to_wall(p, wall) for wall in ARENA) for p in ends]
        assert gaps[0] - gaps[1] < 1.1 * SKIN
        assert clearance(body, ARENA) > 0.0
        hits += share < 1.0
    assert 300 < hits < 2000


def test_random_driving_never_gets_stuck():
    rng = np.random.default_rng(2)
    body = UnicycleBody(RADIUS, ARENA)
    body.place((-3.0, 0.0, 0.3))
    rest = longest_rest = 0
    visited = set()
    for d, alpha in rng.normal([0.3, 0.0], [0.4, 0.8], size=(20000, 2)).tolist():
        rest = 0 if body.drive((d, alpha)) > 0.0 else rest + 1
        longest_rest = max(longest_rest, rest)
        visited.add(tuple(np.floor(body.pose[:2]).astype(int).tolist()))
    assert longest_rest < 30
    assert len(visited) == 64  # every square metre of the arena


def test_reported_poses_are_copies():
    body = UnicycleBody(RADIUS)
    body.pose[:] = 9.0
    assert body.pose.tolist() == [0.0, 0.0, 0.0]
