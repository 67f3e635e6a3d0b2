import errno
import json
import math
import os
import pickle
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamgym.arrays import LARGEST_EPISODE
from slamgym.sim_configs import (
    Scenario,
    ScenarioError,
    action_sequence,
    list_presets,
    load_scenario,
    place_landmarks,
    save_scenario,
)
from slamgym.sim_configs import scenario_files as files

CUSTOM_LAYOUTS = [
    {"layout": "grid", "rows": 2, "columns": 3, "spacing": 1.5},
    {"layout": "ring", "count": 5, "radius": 2.0, "centre": [1.0, -1.0]},
    {"layout": "corridor", "count": 6, "length": 10.0, "width": 2.0},
    {"layout": "random", "count": 4, "bounds": [-1.0, -2.0, 3.0, 4.0]},
    {"layout": "random", "count": 4, "bounds": [-1.0, -2.0, 3.0, 4.0], "seed": 0},
]


def mistake(table):
    with pytest.raises(ScenarioError) as caught:
        load_scenario(table)
    return str(caught.value)


def mistake_of(**changes):
    with pytest.raises(ScenarioError) as caught:
        load_scenario("six_landmarks").with_changes(**changes)
    return str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": {"max_rage": 3.0}},
         "unknown key 'max_rage' in sensor; did you mean 'max_range'?"),
        ({"stesp": 3}, "unknown key 'stesp' in the scenario; did you mean 'steps'? "
         "(unexpected keyword argument 'stesp')"),
        ({"landmarks": {"layout": "ring", "raduis": 3.0, "count": 3}},
         "unknown key 'raduis' in landmarks; did you mean 'radius'?"),
        ({"zzz": 3}, "unknown key 'zzz' in the scenario; known are "),
        ({"sensor": {"fov": 1}},
         "unknown key 'fov' in sensor; known are field_of_view, dropout, "),
    ],
)  # fmt: skip
def test_an_unknown_key_is_refused_with_a_suggestion(changes, message):
    assert mistake_of(**changes).startswith(message)


def test_of_many_unknown_keys_the_first_is_named():
    wrong = {f"zzz{i}": 0 for i in range(50)}
    assert "unknown key 'zzz0' in the scenario; known" in mistake_of(dt=0.5, **wrong)


@pytest.mark.parametrize("std", [[-1, 0.1], [0.1], [0.1, 0.1, 0.1], 0.1, ["0.1", 0.1]])
def test_a_wrong_sensor_std_is_named(std):
    message = mistake_of(sensor={"std": std})
    assert message == (
        f"sensor.std must be 2 finite numbers >= 0 (σβ, σr) [rad, m], got {std!r}"
    )


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("position", "(σx, σy) [m, m]"),
        ("bearing", "(σβ, 0) [rad]"),
        ("range", "(σr, 0) [m]"),
        ("sonar:SONAR", "in the units of 'sonar:SONAR'"),
    ],
)
def test_a_wrong_sensor_std_is_named_by_the_kind_of_the_sensor(kind, expected):
    message = mistake_of(sensor={"kind": kind, "std": [0.1]})
    assert message == f"sensor.std must be 2 finite numbers >= 0 {expected}, got [0.1]"


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"dt": "3"}, "dt"),
        ({"dt": True}, "dt"),
        ({"dt": 0.0}, "dt"),
        ({"dt": math.inf}, "dt"),
        ({"steps": 3.0}, "steps"),
        ({"steps": True}, "steps"),
        ({"steps": 1}, "steps"),
        ({"name": ""}, "name"),
        ({"name": 3}, "name"),
        ({"description": 3}, "description"),
        ({"start": {"pose": [0.0, 0.0, math.nan]}}, "start.pose"),
        ({"start": {"std": [0.1, 0.1, -0.1]}}, "start.std"),
        ({"start": {"drawn": "both"}}, "start.drawn"),
        ({"robot": {"radius": 0}}, "robot.radius"),
        ({"robot": {"max_speed": -1.0}}, "robot.max_speed"),
        ({"robot": {"max_turn_rate": math.inf}}, "robot.max_turn_rate"),
        ({"motion": {"std": [0.1, 0.1]}}, "motion.std"),
        ({"motion": {"noise_in": "wheels"}}, "motion.noise_in"),
        ({"motion": {"noise_at_rest": 1}}, "motion.noise_at_rest"),
        ({"sensor": {"identities": "true"}}, "sensor.identities"),
        ({"sensor": {"occlusion": 0}}, "sensor.occlusion"),
        ({"sensor": {"max_range": math.nan}}, "sensor.max_range"),
        ({"sensor": {"max_range": True}}, "sensor.max_range"),
        ({"sensor": {"min_range": -0.1}}, "sensor.min_range"),
        ({"sensor": {"range_std_per_metre": -0.1}}, "sensor.range_std_per_metre"),
        ({"sensor": {"field_of_view": 0.0}}, "sensor.field_of_view"),
        ({"sensor": {"field_of_view": 6.3}}, "sensor.field_of_view"),
        ({"sensor": {"dropout": 1.1}}, "sensor.dropout"),
        ({"sensor": {"dropout": -0.1}}, "sensor.dropout"),
        ({"sensor": {"clutter": -1.0}}, "sensor.clutter"),
        ({"sensor": {"max_clutter": 1.5}}, "sensor.max_clutter"),
        ({"sensor": 3}, "sensor"),
        ({"walls": 3}, "walls"),
        ({"walls": [[0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]}, "walls[1]"),
        ({"walls": [[1.0, 2.0, 1.0, 2.0]]}, "walls[0]"),
        ({"landmarks": {"points": [[0.0, 0.0], [0.0, "1"]]}}, "landmarks.points[1]"),
        ({"landmarks": {"points": []}}, "landmarks.points"),
        ({"landmarks": {"layout": "ring", "count": 0, "radius": 1.0}},
         "landmarks.count"),
        ({"landmarks": {"layout": "rnig"}}, "landmarks.layout"),
        ({"controls": {"commands": [[1.0, 0.0, 0]]}}, "controls.commands[0]"),
        ({"controls": {"commands": [[1.0, 0.0, 2.0]]}}, "controls.commands[0]"),
        ({"controls": {"sequence": "cirle"}}, "controls.sequence"),
    ],
)  # fmt: skip
def test_a_bad_value_gets_one_line_that_names_its_field(changes, field):
    message = mistake_of(**changes)
    assert message.startswith(f"{field} must ")
    assert "got" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"motion_dof": 2}, "faults.motion_dof must be a number > 2, or inf, got 2"),
        ({"sensor_dof": "4"}, "faults.sensor_dof must be a number > 2, or inf"),
        ({"odometry_scale": -1}, "faults.odometry_scale must be a finite number > -1"),
        ({"range_bias": np.inf}, "faults.range_bias must be a finite number, got inf"),
        ({"turn_bias": 0.1}, "unknown key 'turn_bias' in faults; did you mean"),
    ],
)
def test_an_impossible_fault_is_refused(fault, message):
    assert mistake_of(faults=fault).startswith(message)


def test_every_missing_field_gets_a_line_of_its_own():
    lines = mistake({"name": "x", "dt": 1.0}).splitlines()
    assert "unknown key 'zzz' in the scenario; k" in mistake({"name": "x", "zzz": 1.0})
    assert lines == [
        f"{field} must be given" for field in ("motion", "sensor", "landmarks")
    ]


def test_a_file_of_ten_lines_describes_a_drive(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(
        'name = "small"\n[motion]\nstd = [0.02, 0.0, 0.02]\n[sensor]\n'
        'std = [0.02, 0.1]\n[landmarks]\nlayout = "grid"\nrows = 2\ncolumns = 3\n'
        "spacing = 2.0\n"
    )
    scenario = load_scenario(path)
    actions = action_sequence(scenario)
    assert scenario.landmarks.count == 6
    assert len(actions) == scenario.steps
    assert np.all(np.abs(actions) <= (scenario.robot.max_speed, 1.0))


CLUTTER = {"clutter": 1.0, "max_clutter": 6, "identities": False, "max_range": 5.0}
NO_CLUTTER = "sensor.clutter must be 0 unless"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"landmarks": {"layout": "ring", "count": 3}},
         "landmarks.radius must be given"),
        ({"landmarks": {"layout": "streets", "columns": 3, "rows": 2, "side": 9.0,
                        "width": 9.0, "per_front": 2}},
         r"landmarks\.width must be < side = 9\.0"),
        ({"landmarks": {"layout": "rnig"}},
         r"landmarks.layout must .*got 'rnig'; did you mean 'ring'\?$"),
        ({"controls": {"sequence": "spirral"}},
         r"controls.sequence must .*got 'spirral'; did you mean 'spiral'\?$"),
        ({"motion": {"noise_in": "odometry"}},
         r"motion.std must have σy = 0 with noise_in = 'odometry'"),
        ({"sensor": {"min_range": 2.0, "max_range": 2.0}},
         r"sensor.min_range must be < max_range = 2.0, got 2.0$"),
        ({"sensor": CLUTTER | {"identities": True}}, NO_CLUTTER),
        ({"sensor": CLUTTER | {"max_range": math.inf}}, NO_CLUTTER),
        ({"sensor": CLUTTER | {"clutter": 2.0, "max_clutter": 1}},
         r"sensor.max_clutter must be >= clutter = 2.0"),
        ({"robot": {"max_speed": 0.5}},
         r"controls must stay within robot.max_speed = 0.5 m/s, got 1 m/s$"),
        ({"controls": {"commands": [(-9.0, 0.0, 1), (0.1, 0.0, 1)]}},
         r"controls must stay within robot.max_speed = 1.0 m/s, got 3 m/s$"),
        ({"robot": {"max_turn_rate": 0.1}},
         r"controls must stay within robot.max_turn_rate = 0.1 rad/s"),
        ({"steps": LARGEST_EPISODE + 1},
         rf"steps must be at most {LARGEST_EPISODE}, got {LARGEST_EPISODE + 1}$"),
        ({"walls": [(0, 0, 1, 1), (2, 3, 2, 3)]},
         r"walls\[1\] must have a length > 0, got \(2.0, 3.0, 2.0, 3.0\)$"),
        ({"sensor": 3}, "sensor must be a table, got 3$"),
        ({"walls": 3}, "walls must be a list, got 3$"),
        ({"landmarks": {"points": []}},
         r"landmarks.points must be a list that is not empty, got \[\]$"),
        ({"robot": {"drive": "differential"}},
         "robot.track_width must be given with drive = 'differential'$"),
        ({"robot": {"max_speed": 5e11}},
         r"robot.max_speed must not exceed 1e\+12 / dt, .* 500000000000.0 with dt = 3"),
        ({"robot": {"drive": "bicycle", "wheelbase": 1.0, "max_steering": 0.5},
          "controls": {"commands": [(1.0, 0.5, 1), (0.1, 0.3, 1)]}},
         r"controls must turn .* = 0.0546302 rad in a step of 0.1 m, got 0.3 rad$"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(changes, message):
    assert re.match(message, mistake_of(**changes))


def test_a_layout_without_its_name_is_refused():
    table = load_scenario("six_landmarks").model_dump()
    del table["landmarks"]["layout"]
    assert mistake(table) == (
        "landmarks.layout must be given, one of points, grid, ring, corridor, streets, "
        "random"
    )


def test_a_command_may_exceed_its_limit_by_a_rounding_error():
    changes = {"controls": {"commands": [(2.1, 0.0, 1)]}, "robot": {"max_speed": 3.0}}
    fastest = load_scenario("six_landmarks").with_changes(dt=0.7, **changes)
    assert action_sequence(fastest)[0, 0] > 3.0


def test_two_scenarios_differ_in_the_first_setting_that_does():
    one = load_scenario("six_landmarks")
    for changes, difference in (
        ({}, ""),
        ({"steps": 7, "sensor": {"max_range": 4.0}}, "steps must be 29, got 7"),
        ({"sensor": {"max_range": 4.0}}, "sensor.max_range must be inf, got 4.0"),
        ({"compass": {"std": 0.1}}, "compass must be None, got Compass(std=0.1"),
    ):
        assert one.difference(one.with_changes(**changes)).startswith(difference)
        assert bool(one.difference(one.with_changes(**changes))) == bool(changes)
    other = one.with_changes(sensor={"kind": "position"})
    with pytest.raises(ScenarioError) as caught:
        other.refuse_models("a part")
    message = "a part accepts only sensor = 'bearing_range', got 'position'"
    assert str(caught.value) == message


def test_integers_stand_for_floats_and_become_floats():
    sensor = {"std": [0, 1], "dropout": 1}
    scenario = load_scenario("six_landmarks").with_changes(dt=4, sensor=sensor)
    assert isinstance(scenario.dt, float)
    assert scenario.sensor.std == (0.0, 1.0)


def test_arrays_and_numpy_scalars_are_taken_as_numbers():
    scenario = load_scenario("six_landmarks").with_changes(
        dt=np.float64(4.0), steps=np.int64(7), landmarks={"points": np.eye(2)}
    )
    assert scenario.landmarks.points == ((1.0, 0.0), (0.0, 1.0))
    assert scenario.steps == 7


def test_a_change_leaves_its_neighbours_and_the_original_alone():
    before = load_scenario("six_landmarks")
    after = before.with_changes(sensor={"max_range": 4.0}, steps=10)
    assert before == load_scenario("six_landmarks")
    assert (after.sensor.max_range, after.steps) == (4.0, 10)
    assert after.with_changes(sensor={"max_range": math.inf}, steps=29) == before


def test_another_layout_replaces_the_old_one_whole():
    ring = {"layout": "ring", "count": 3, "radius": 2.0}
    scenario = load_scenario("six_landmarks").with_changes(landmarks=ring)
    assert scenario.landmarks.count == 3
    wider = scenario.with_changes(landmarks={"layout": "ring", "radius": 4.0})
    assert (wider.landmarks.count, wider.landmarks.radius) == (3, 4.0)


def test_a_part_replaces_a_part():
    sensor = load_scenario("loop").sensor
    assert load_scenario("six_landmarks").with_changes(sensor=sensor).sensor == sensor


def test_scenarios_are_frozen_hashable_values():
    scenario = load_scenario("six_landmarks")
    assert hash(scenario) == hash(load_scenario("six_landmarks"))
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    with pytest.raises(ValueError, match="frozen"):
        scenario.steps = 3
    with pytest.raises(ValueError, match="frozen"):
        scenario.sensor.max_range = 3.0


def test_a_scenario_loads_as_itself():
    scenario = load_scenario("loop")
    assert load_scenario(scenario) is scenario


def test_a_mapping_of_json_types_loads():
    scenario = load_scenario("corridor")
    assert load_scenario(json.loads(json.dumps(scenario.model_dump()))) == scenario


@pytest.mark.parametrize("source", [3, [], None])
def test_anything_else_is_refused(source):
    assert mistake(source).startswith("scenario must be a preset's name, ")
    said = mistake("six_landmark")
    assert said.endswith("got 'six_landmark'; did you mean 'six_landmarks'?")


def test_a_missing_file_is_named(tmp_path):
    path = tmp_path / "none.toml"
    for source in (path, str(path), tmp_path):
        assert mistake(source).startswith(f"cannot read the scenario '{source}': ")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'name = "x"\ndt = = 3\n', ", line 2: Invalid value"),
        (b'name = "x', ", end of document: "),
        (b"name = '\xff'", " must be UTF-8 text"),
    ],
)
def test_a_damaged_file_is_named(content, message, tmp_path):
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    assert mistake(path).startswith(f"{path}{message}")


def test_a_mistake_in_a_file_names_the_file(tmp_path):
    path = tmp_path / "typo.toml"
    text = (Path(files.__file__).parent / "presets/loop.toml").read_text()
    path.write_text(text.replace("max_range", "max_rage"))
    assert mistake(path) == (
        f"{path}: unknown key 'max_rage' in sensor; did you mean 'max_range'?"
    )


def test_every_preset_loads_back_equal_and_is_as_documented(tmp_path):
    folder = Path(files.__file__).parent / "presets"
    for name in list_presets():
        scenario = load_scenario(name)
        assert scenario.name == name
        assert max(scenario.robot.max_speed, scenario.robot.max_turn_rate) <= 1, name
        save_scenario(scenario, tmp_path / "copy.toml")
        assert load_scenario(tmp_path / "copy.toml") == scenario
        head = (folder / f"{name}.toml").read_text(encoding="utf-8").splitlines()[0]
        schema = folder / head.removeprefix("#:schema ")
        assert schema.resolve() == files.SCHEMA_FILE.resolve(), name
        first, second = (
            place_landmarks(scenario.landmarks, np.random.default_rng(seed))
            for seed in (1, 2)
        )
        assert np.array_equal(first, second) != name.startswith("active_"), name


@pytest.mark.parametrize("layout", CUSTOM_LAYOUTS)
def test_a_saved_layout_loads_back_equal(layout, tmp_path):
    strange = {"name": '"\\\x7f\n é', "landmarks": layout}
    scenario = load_scenario("six_landmarks").with_changes(**strange)
    save_scenario(scenario, tmp_path / "copy.toml")
    assert load_scenario(tmp_path / "copy.toml") == scenario


def test_a_description_of_one_long_word_is_read_at_once(tmp_path):
    scenario = load_scenario("six_landmarks").with_changes(description="a" * 10**5)
    save_scenario(scenario, tmp_path / "long.toml")
    start = time.process_time()
    assert load_scenario(tmp_path / "long.toml") == scenario
    assert time.process_time() - start < 5.0  # a minute where it is quadratic


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    name=st.text(min_size=1),
    number=st.floats(min_value=1e-12, max_value=1e12),
    flag=st.booleans(),
)
def test_any_text_and_number_survives_a_file(name, number, flag, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "copy.toml"
    scenario = load_scenario("six_landmarks").with_changes(
        name=name,
        sensor={"std": [number, 0.1], "occlusion": flag},
        robot={"radius": np.float64(number)},
    )
    save_scenario(scenario, path)
    assert load_scenario(path) == scenario


def test_the_schema_file_equals_the_model():
    assert files.SCHEMA_FILE.read_text(encoding="utf-8") == files.scenario_schema(), (
        "write scenario_schema() to sim_configs/scenario.schema.json"
    )


def test_the_schema_knows_every_field_with_a_description():
    schema = json.loads(files.SCHEMA_FILE.read_text(encoding="utf-8"))
    tables = [schema, *schema["$defs"].values()]
    fields = [item for table in tables for item in table["properties"].items()]
    assert len(fields) > 40
    for name, field in fields:
        assert "description" in field or name in ("layout", "sequence")
    assert all(table["additionalProperties"] is False for table in tables)


def test_the_schema_asks_for_the_name_of_a_layout():
    schema = json.loads(files.SCHEMA_FILE.read_text(encoding="utf-8"))
    assert "layout" in schema["$defs"]["RingLayout"]["required"]
    assert "sequence" in schema["$defs"]["CircleSequence"]["required"]


def test_the_constructor_takes_typed_parts():
    loop = load_scenario("loop")
    fields = {name: getattr(loop, name) for name in Scenario.model_fields}
    assert Scenario(**fields) == loop


def test_importing_scenarios_loads_nothing_heavy():
    code = (
        "import sys, slamgym.sim_configs\n"
        "heavy = {'scipy', 'numba', 'pymunk', 'matplotlib', 'rich', 'typer'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def _fail_to_write(path, name):
    with files.replace_when_written(path) as partial:
        partial.write_text("half")
        name = str(partial) if name == "partial" else name
        raise OSError(errno.EFBIG, "File too large", name)


def test_a_file_is_written_under_a_hidden_name_of_its_process(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text("former")
    with files.replace_when_written(path) as partial:
        assert partial.parent == tmp_path
        name = re.escape(f".map.{os.getpid()}@{platform.node()}-")
        assert re.fullmatch(rf"{name}[0-9a-f]{{8}}\.toml", partial.name)
        assert partial in files.unfinished
        partial.write_text("new")
        assert path.read_text() == "former"
    assert (path.read_text(), partial in files.unfinished) == ("new", False)
    for name, named in ((None, "map.toml"), ("partial", "map.toml"), ("other",) * 2):
        with pytest.raises(OSError, match="too large") as caught:
            _fail_to_write(path, name)
        assert Path(caught.value.filename).name == named
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(
        FileNotFoundError, match=r"the folder of .*a/map does not exist"
    ):
        files.replace_when_written(tmp_path / "a" / "map").__enter__()


def test_only_files_left_by_ended_processes_of_this_machine_are_removed(
    tmp_path, monkeypatch
):
    def refuse(*_):
        raise PermissionError

    ended, node = 2**22 + 7, platform.node()  # no process has so large a number
    gone = tmp_path / f".map.{ended}@{node}-01234567.toml"
    kept = [
        tmp_path / f".map.{os.getpid()}@{node}-01234567.toml",
        tmp_path / f".map.{ended}@another-01234567.toml",
        tmp_path / f".map.{10**20}@{node}-01234567.toml",
        tmp_path / f"map.{ended}@{node}-01234567.toml",
    ]
    for path in (gone, *kept):
        path.touch()
    files.remove_unfinished(tmp_path)
    assert set(tmp_path.iterdir()) == set(kept)
    monkeypatch.setattr(os, "kill", refuse)  # as for a process of another user
    gone.touch()
    files.remove_unfinished(tmp_path)
    assert gone.exists()
