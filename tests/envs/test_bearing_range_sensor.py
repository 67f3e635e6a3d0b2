import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
from far_origins import FAR
from worlds import RANDOM_MAP

from slamgym.envs.bearing_range import BearingRangeSensor, LineOfSight, hide_identities
from slamgym.envs.noise_streams import NoiseRows, SensorSettings, WorldNoise, row_of
from slamgym.envs.random_numbers import episode_keys
from slamgym.sim_configs import load_scenario

BASE = load_scenario("six_landmarks").with_changes(
    landmarks={**RANDOM_MAP, "count": 40, "min_distance": 0.2, "seed": 1}
)
COUNT = BASE.landmarks.count
POSE = (0.7, -0.4, 2.2)


def scenario_with(**sensor):
    return BASE.with_changes(sensor=sensor)


def points(rng, count=COUNT, size=9.0):
    x, y = rng.uniform(-size, size, (2, count))
    return x + 1j * y


def key_of(seed):
    return episode_keys([np.random.default_rng(seed)])


def noise_of_steps(scenario, count):
    keys = np.repeat(key_of(0), count, axis=0)
    return WorldNoise(scenario).sensor(keys, np.arange(count))


def rows_of(scenario, seed=0):
    rows = NoiseRows(WorldNoise(scenario).sensor, row_of)
    rows.begin(key_of(seed), first=0)
    return rows


def noise_of(scenario, seed=0):
    return next(rows_of(scenario, seed))


def unit_noise(bearings, ranges):
    """Noise of a sensor without dropout, in standard deviations."""
    return np.concatenate([bearings, ranges])[None], np.empty((1, 0)), None, None


def silent(scenario):
    """Noise of a sensor that never errs."""
    return unit_noise(*np.zeros((2, scenario.landmarks.count)))


def frames(x, y, theta):
    return np.array([x, y, theta, np.cos(theta), np.sin(theta)], dtype=float)


def scan(scenario, landmarks, pose, noise):
    """Return all bearings and all ranges, (2, N), and the mask."""
    sensor, frame = BearingRangeSensor(scenario), frames(*pose)[:, None]
    measurements, mask = sensor.scan(landmarks[None], frame, noise)
    return measurements[0].T, mask[0]


def true_readings(landmarks, pose):
    """Bearing and range by trigonometry, landmark by landmark."""
    x, y, theta = pose
    rows = []
    for to in landmarks.tolist():
        dx, dy = to.real - x, to.imag - y
        bearing = math.remainder(math.atan2(dy, dx) - theta, math.tau)
        rows.append((bearing, math.hypot(dx, dy)))
    return np.transpose(rows)


def angle_gap(a, b):
    return np.abs(np.exp(1j * a) - np.exp(1j * b))


def one_landmark(bearing, distance, theta=0.0):
    """A scenario with one landmark, and that landmark seen from the origin."""
    scenario = BASE.with_changes(landmarks={"layout": "points", "points": [[0, 0]]})
    return scenario, np.array([distance * np.exp(1j * (theta + bearing))])


# --- what is read ---


def test_readings_are_the_measurement_model_plus_noise():
    rng = np.random.default_rng(0)
    for seed in range(200):
        pose, landmarks = (*rng.uniform(-5, 5, 2), rng.uniform(-20, 20)), points(rng)
        noise = noise_of(BASE, seed)
        readings, mask = scan(BASE, landmarks, pose, noise)
        error = noise[0].reshape(2, -1) * np.array(BASE.sensor.std)[:, None]
        expected = true_readings(landmarks, pose) + error
        assert mask.sum() > 30
        assert angle_gap(readings[0], expected[0])[mask].max() < 1e-12
        assert np.abs(readings[1] - expected[1])[mask].max() < 1e-12
        assert (readings[0] >= -np.pi).all()
        assert (readings[0] < np.pi).all()


def test_unseen_rows_are_zero():
    readings, mask = scan(
        scenario_with(max_range=4.0), points(np.random.default_rng(0)), POSE,
        noise_of(BASE),
    )  # fmt: skip
    assert 0 < mask.sum() < COUNT
    assert (readings[:, ~mask] == 0.0).all()
    assert (readings[:, mask] != 0.0).all()


def test_a_landmark_straight_behind_reads_minus_pi():
    scenario, _ = one_landmark(0.0, 1.0)
    readings, _ = scan(scenario, np.array([-3.0 + 0j]), (0, 0, 0), silent(scenario))
    assert readings[:, 0].tolist() == [-np.pi, 3.0]


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("view", [6.0, 2 * np.pi])
def test_noise_takes_a_bearing_across_the_back_by_wrapping(sign, view):
    scenario, landmarks = one_landmark(sign * 2.95, 2.0)
    scenario = scenario.with_changes(sensor={"field_of_view": view, "std": [0.1, 0.1]})
    noise = unit_noise([sign * 3.0], [0.0])
    readings, _ = scan(scenario, landmarks, (0, 0, 0), noise)
    assert readings[0, 0] == pytest.approx(sign * (3.25 - 2 * np.pi))


def wrapped_by_noise(angles):
    """Return the bearings that are read straight ahead with angles as noise."""
    scenario, ahead = scenario_with(std=(1.0, 1.0)), np.ones(len(angles)) + 0j
    return scan(scenario, ahead, (0, 0, 0), unit_noise(angles, 0.0 * angles))[0][0]


def test_wrapped_bearings_lie_in_range_and_those_in_range_keep_every_bit():
    inside = np.random.default_rng(0).uniform(-np.pi, np.pi, 10000)
    wrapped = wrapped_by_noise(inside)
    np.testing.assert_array_equal(wrapped, inside)
    steps = [np.nextafter(k * np.pi, s) for k in range(-9, 10) for s in (-99, 99)]
    edges = np.array([*steps, *(k * np.pi for k in range(-9, 10)), 40.0, -40.0])
    wrapped = wrapped_by_noise(edges)
    assert (wrapped >= -np.pi).all()
    assert (wrapped < np.pi).all()
    assert angle_gap(wrapped, edges).max() < 1e-14


def test_range_noise_grows_with_the_range():
    grown = scenario_with(range_std_per_metre=0.2, std=(0.01, 0.05))
    landmarks = points(np.random.default_rng(0))
    truth = true_readings(landmarks, POSE)
    unit = noise_of(BASE)[0][0, COUNT:]
    readings, mask = scan(grown, landmarks, POSE, noise_of(grown))
    expected = truth[1] + (0.05 + 0.2 * truth[1]) * unit
    np.testing.assert_allclose(readings[1, mask], expected[mask], atol=1e-12)
    np.testing.assert_array_equal(mask, (expected > 0) & (truth[1] >= 0.05))


@pytest.mark.parametrize("per_metre", [0.0, 0.5, 2.0])
def test_a_reading_without_a_positive_range_is_not_reported(per_metre):
    scenario = scenario_with(
        std=(0.01, 2.0), range_std_per_metre=per_metre, min_range=0.0
    )
    rng, dropped = np.random.default_rng(0), 0
    rows = rows_of(scenario)
    for _ in range(300):
        noise, landmarks = next(rows), points(rng)
        readings, mask = scan(scenario, landmarks, POSE, noise)
        true = true_readings(landmarks, POSE)[1]
        error = (2.0 + per_metre * true) * noise[0][0, COUNT:]
        np.testing.assert_array_equal(mask, true + error > 0.0)
        assert (readings[1, mask] > 0.0).all()
        dropped += (~mask).sum()
    assert dropped > 200


# --- what is seen ---


@pytest.mark.parametrize(
    ("distance", "seen"), [(0.999, False), (1.0, True), (4.0, True), (4.001, False)]
)
def test_the_true_range_decides_what_is_in_reach_limits_included(distance, seen):
    scenario, _ = one_landmark(0.0, 1.0)
    limits = {"min_range": 1.0, "max_range": 4.0, "std": [0.1, 0.5]}
    scenario = scenario.with_changes(sensor=limits)
    for unit in (-1.0, 0.0, 1.0):  # the noisy range crosses the limits, in vain
        noise = unit_noise([0.0], [unit])
        _, mask = scan(scenario, np.array([distance + 0j]), (0, 0, 0), noise)
        assert mask.tolist() == [seen]


def test_a_landmark_at_the_nearest_range_itself_is_read():
    scenario, landmarks = one_landmark(0.0, 1.0)
    scenario = scenario.with_changes(sensor={"min_range": 1.0, "std": [0.1, 0.0]})
    _, mask = scan(scenario, landmarks, (0, 0, 0), noise_of(scenario))
    assert mask.tolist() == [True]


@pytest.mark.parametrize("view", [0.5, np.pi / 2, np.pi, 5.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_true_bearing_decides_what_is_in_view(view, side):
    for offset, seen in ((-1e-9, True), (1e-9, False)):
        scenario, landmarks = one_landmark(side * (view / 2 + offset), 3.0, theta=1.0)
        sensor = {"field_of_view": view, "std": [0.1, 0.1]}
        scenario = scenario.with_changes(sensor=sensor)
        for unit in (-2.0, 0.0, 2.0):
            noise = unit_noise([unit], [0.0])
            _, mask = scan(scenario, landmarks, (0, 0, 1.0), noise)
            assert mask.tolist() == [seen]


def test_a_full_view_sees_all_around():
    bearings = np.linspace(-np.pi, np.pi, COUNT)
    _, mask = scan(BASE, 3 * np.exp(1j * bearings), (0, 0, 0), silent(BASE))
    assert mask.all()


def test_a_reading_drops_out_with_the_given_probability():
    scenario = scenario_with(dropout=0.3, min_range=0.0, std=(0.01, 0.0))
    lots = noise_of_steps(scenario, 5000)[1]
    dropped = lots < 0.3
    assert dropped.mean() == pytest.approx(0.3, abs=0.005)
    assert np.abs(np.corrcoef(dropped.T) - np.eye(COUNT)).max() < 0.08
    landmarks = points(np.random.default_rng(1))
    noise = (np.zeros((1, 2 * COUNT)), lots[:1], None, None)
    np.testing.assert_array_equal(
        scan(scenario, landmarks, POSE, noise)[1], ~dropped[0]
    )


# --- walls ---


def crosses(robot, landmark, wall):
    """Whether robot-landmark meets the closed wall, in exact integer arithmetic."""

    def turn(a, b, c):
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    a, b = wall[:2], wall[2:]
    passes_between = turn(robot, landmark, a) * turn(robot, landmark, b) <= 0
    lies_behind = turn(a, b, robot) * turn(a, b, landmark) < 0  # in line: in front
    return passes_between and lies_behind


def test_occlusion_is_the_exact_crossing_of_segments():
    rng = np.random.default_rng(0)
    hidden = 0
    for _ in range(150):
        walls = rng.integers(-6, 7, (5, 4)).tolist()
        walls = [wall for wall in walls if wall[:2] != wall[2:]]
        grid, robot = rng.integers(-8, 9, (COUNT, 2)), rng.integers(-8, 9, 2).tolist()
        places, eye = grid @ np.array([1, 1j]), np.array(robot, dtype=float)
        (blocked,) = LineOfSight(walls).blocked(places[None], eye[:, None])
        for to, found in zip(grid.tolist(), blocked, strict=True):
            assert found == any(crosses(robot, to, wall) for wall in walls)
        hidden += blocked.sum()
    assert hidden > 1000


@pytest.mark.parametrize("origin", [(0.0, 0.0), *FAR.values()], ids=["0", *FAR])
@pytest.mark.parametrize("height", [-1.0, 1.0])
def test_a_landmark_mounted_on_a_wall_is_seen_from_both_sides(height, origin):
    wall = np.array([0.1, 0.3, 3.7, 1.9]) + np.tile(origin, 2)
    a, b = complex(*wall[:2]), complex(*wall[2:])
    mounted = a + np.linspace(0.01, 0.99, 99) * (b - a)
    robot = np.add(origin, (2.0, 5.0 * height))[:, None]
    assert not LineOfSight([wall]).blocked(mounted[None], robot).any()


def test_walls_hide_landmarks_only_when_asked_to():
    walls = {"walls": [[2.0, -1.0, 2.0, 1.0]]}
    landmarks = np.array([1.0 + 0j, 3.0 + 0j, 3.0 + 3j])
    scenario = BASE.with_changes(
        landmarks={"layout": "points", "points": [[0, 0]] * 3}, **walls
    )
    for occlusion, seen in ((False, [1, 1, 1]), (True, [1, 0, 1])):
        scenario = scenario.with_changes(sensor={"occlusion": occlusion})
        _, mask = scan(scenario, landmarks, (0, 0, 0), silent(scenario))
        assert mask.tolist() == seen


# --- hidden identities ---

HIDDEN = scenario_with(
    identities=False, clutter=2.0, max_clutter=9, max_range=6.0, field_of_view=2.0
)


def hidden_scans(count, scenario=HIDDEN):
    rows = rows_of(scenario, 5)
    landmarks = points(np.random.default_rng(6))
    for _ in range(count):
        noise = next(rows)
        readings, mask = scan(scenario, landmarks, POSE, noise)
        yield readings.T, mask, noise, hide_identities(readings.T, mask, noise)


def test_rows_are_packed_at_the_front():
    for _, _, _, anonymous in hidden_scans(200):
        count = anonymous.mask.sum()
        assert anonymous.mask.tolist() == [True] * count + [False] * (49 - count)
        assert (anonymous.readings[count:] == 0.0).all()
        assert (anonymous.landmark_ids[count:] == -1).all()


def test_ids_tell_the_landmark_of_every_row_and_the_rest_is_the_clutter():
    for readings, mask, noise, anonymous in hidden_scans(200):
        ids = anonymous.landmark_ids
        real = ids >= 0
        assert sorted(ids[real].tolist()) == np.flatnonzero(mask).tolist()
        np.testing.assert_array_equal(anonymous.readings[real], readings[ids[real]])
        false = anonymous.readings[anonymous.mask & ~real, 1]
        clutter = noise[2][:, 1]
        assert sorted(false.tolist()) == sorted(clutter[clutter > 0].tolist())


def test_every_order_of_the_rows_is_equally_likely():
    first = [anonymous.landmark_ids[0] for *_, anonymous in hidden_scans(3000)]
    _, counts = np.unique(first, return_counts=True)
    real = counts[1:]
    assert real.min() > 0.7 * real.mean()
    assert real.max() < 1.3 * real.mean()


@pytest.mark.parametrize("mean", [0.5, 1.0, 2.0])
def test_clutter_is_uniform_over_what_the_sensor_sees_and_poisson_in_number(mean):
    world = HIDDEN.with_changes(sensor={"clutter": mean})
    bearings, ranges = np.moveaxis(noise_of_steps(world, 20000)[2], -1, 0)
    present = ranges > 0
    counts = present.sum(axis=1)
    assert counts.mean() == pytest.approx(mean, abs=0.03)
    assert counts.var() == pytest.approx(mean, abs=0.06)
    assert len(np.unique(bearings[present])) == counts.sum()
    assert (bearings[~present] == 0.0).all()
    for values, low, high in ((bearings, -1.0, 1.0), (ranges, 0.05, 6.0)):
        share = np.sort((values[present] - low) / (high - low))
        gap = np.abs(share - (np.arange(len(share)) + 0.5) / len(share)).max()
        assert gap < 1.95 / math.sqrt(len(share))  # Kolmogorov, 1 in 1000
        assert share[0] > 0.0
        assert share[-1] <= 1.0


def test_a_false_reading_may_have_the_longest_range_but_not_the_shortest():
    settings = SensorSettings.of(HIDDEN.sensor)
    drawn = np.zeros((1, 19))
    drawn[0, 0] = settings.counts_below[0, 0]  # the first number that is one reading
    clutter = WorldNoise(HIDDEN)._clutter(1, drawn, settings)
    np.testing.assert_array_equal(clutter[0], [(-1.0, 6.0)] + 8 * [(0.0, 0.0)])


def test_hidden_identities_without_clutter_reserve_no_rows():
    scenario = scenario_with(identities=False)
    for _, mask, _, anonymous in hidden_scans(5, scenario):
        assert anonymous.mask.shape == (COUNT,)
        assert anonymous.mask.sum() == mask.sum()


# --- noise drawn ahead ---


def test_the_length_of_a_block_changes_nothing(monkeypatch):
    def rows(steps):
        monkeypatch.setattr("slamgym.envs.noise_streams._FIRST_BLOCK", steps)
        scenario = HIDDEN.with_changes(sensor={"dropout": 0.2})
        noise = rows_of(scenario)
        return [next(noise) for _ in range(40)]

    for row, other in zip(rows(7), rows(64), strict=True):
        for a, b in zip(row, other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_an_interrupted_draw_is_drawn_again_at_the_next_call():
    interrupts = iter([True, False] * 10)

    def draw(key, steps):
        if next(interrupts):
            raise KeyboardInterrupt
        return key + steps

    rows = NoiseRows(draw, lambda noise, k: noise[k])
    rows.begin(100, first=1)
    for step in range(1, 50):
        try:
            row = next(rows)
        except KeyboardInterrupt:
            row = next(rows)
        assert row == 100 + step


def test_noise_has_the_given_standard_deviations():
    count, landmarks = 3000, points(np.random.default_rng(0))
    readings, mask = BearingRangeSensor(BASE).scan(
        np.tile(landmarks, (count, 1)),
        frames(*np.zeros((3, count))),
        noise_of_steps(BASE, count),
    )
    error = readings - true_readings(landmarks, (0.0, 0.0, 0.0)).T
    error[..., 0] = np.angle(np.exp(1j * error[..., 0]))
    error = error[mask]
    np.testing.assert_allclose(error.std(axis=0), BASE.sensor.std, rtol=0.01)
    assert abs(np.corrcoef(error.T)[0, 1]) < 0.01


# --- worlds side by side ---


def test_many_worlds_at_once_are_each_alone_to_the_last_bit():
    worlds, rng = 7, np.random.default_rng(0)
    scenario = HIDDEN.with_changes(
        walls=[[-2.0, -9.0, -2.0, 9.0], [0.0, 3.0, 5.0, 3.5]],
        sensor={
            "occlusion": True, "field_of_view": 6.0, "std": (0.5, 0.1), "dropout": 0.1
        },
    )  # fmt: skip
    noises = [noise_of(scenario, seed) for seed in range(worlds)]
    unit, lots, clutter, order = zip(*noises, strict=True)
    together = *map(np.concatenate, (unit, lots)), np.stack(clutter), np.stack(order)
    landmarks = np.stack([points(rng) for _ in range(worlds)])
    positions, headings = points(rng, worlds, 3.0), rng.uniform(-9, 9, worlds)
    frame = frames(positions.real, positions.imag, headings)
    sensor = BearingRangeSensor(scenario)
    readings, mask = sensor.scan(landmarks, frame, together)
    hidden = hide_identities(readings, mask, together)
    for e, noise in enumerate(noises):
        at = slice(e, e + 1)
        alone = sensor.scan(landmarks[at], frame[:, at].copy(), noise)
        np.testing.assert_array_equal(readings[at], alone[0])
        np.testing.assert_array_equal(mask[at], alone[1])
        packed = hide_identities(alone[0][0], alone[1][0], noise)
        np.testing.assert_array_equal(hidden.readings[e], packed.readings)
        np.testing.assert_array_equal(hidden.mask[e], packed.mask)
        np.testing.assert_array_equal(hidden.landmark_ids[e], packed.landmark_ids)
    assert 10 < mask.sum() < mask.size - 10


def test_a_scan_changes_nothing_in_the_sensor():
    sensor, landmarks = BearingRangeSensor(BASE), points(np.random.default_rng(0))
    before = pickle.dumps(sensor)
    sensor.scan(landmarks[None], frames(*POSE)[:, None], noise_of(BASE))
    assert pickle.dumps(sensor) == before  # states share it, also between threads


def test_neighbouring_steps_have_different_noise():
    rows = rows_of(BASE)
    for before, after in pairwise(next(rows) for _ in range(200)):
        assert (before[0] != after[0]).all()
