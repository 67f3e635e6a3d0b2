"""Scenarios hold no number whose products or quotients overflow."""

import pytest

from slamgym.sim_configs import load_scenario
from slamgym.sim_configs.field_types import ScenarioError

GRID = {"layout": "grid", "rows": 3, "columns": 2, "spacing": 1.0}


def changed(**changes):
    return load_scenario("six_landmarks").with_changes(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dt": 1e308}, "dt must not exceed 1e[+]12, got 1e[+]308"),
        ({"dt": 5e-324}, "dt must be at least 1e-12, got 5e-324"),
        ({"robot": {"max_speed": 1e308}}, "robot.max_speed must not exceed 1e[+]12"),
        ({"robot": {"max_speed": 1e12}}, "max_speed must not exceed 1e[+]12 / dt"),
        ({"start": {"pose": (0.0, 1e160, 0.0)}}, "start.pose must not exceed 1e[+]12"),
        ({"start": {"std": (1e160, 0.0, 0.0)}}, "start.std must not exceed 1e[+]12"),
        ({"motion": {"std": (2e12, 0.0, 0.0)}}, "motion.std must not exceed 1e[+]12"),
        ({"sensor": {"std": (0.1, 1e13)}}, "sensor.std must not exceed 1e[+]12"),
        ({"sensor": {"max_range": 1e13}}, "sensor.max_range must not exceed 1e[+]12"),
        ({"faults": {"range_bias": -1e13}}, "faults.range_bias must not exceed"),
        ({"faults": {"sensor_dof": 1e300}}, "faults.sensor_dof must not exceed"),
        ({"walls": [(0.0, 0.0, 1e200, 0.0)]}, r"walls\[0\] must not exceed 1e[+]12"),
        ({"randomise": {"start_x": [0.0, 1e200]}}, "randomise.start_x must not exceed"),
        ({"steps": 2**63}, "steps must be at most 1000000000, got 9223372036854775808"),
        ({"landmarks": GRID | {"spacing": 1e300}}, "landmarks.spacing must not exceed"),
        ({"landmarks": GRID | {"rows": 2**63}}, "landmarks.rows must not exceed"),
        ({"landmarks": GRID | {"rows": 10**8}}, "landmarks must be at most 10000000, "),
        (
            {"sensor": {"identities": False, "max_clutter": 10**8}},
            "sensor.max_clutter must be at most 10000000, got 100000000",
        ),
        (
            {"landmarks": {"layout": "ring", "count": 2**63, "radius": 5.0}},
            "landmarks.count must not exceed 1e[+]12, got 9223372036854775808",
        ),
        (
            {"controls": {"sequence": "commands", "commands": [(0.0, 0.0, 10**400)]}},
            r"controls.commands\[0\] must not exceed 1e[+]12",
        ),
    ],
)
def test_a_number_beyond_the_bound_is_refused_by_name(changes, message):
    with pytest.raises(ScenarioError, match=message):
        changed(**changes)


def test_numbers_at_the_bound_and_a_sensor_without_limit_are_accepted():
    world = changed(
        dt=1e12,
        robot={"max_speed": 1.0, "max_turn_rate": 1.0},
        start={"pose": (1e12, -1e12, 1e12), "std": (1e12, 0.0, 0.0)},
        sensor={"max_range": float("inf")},
    )
    assert world.dt == 1e12
