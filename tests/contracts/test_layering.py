"""The floors of the repository, enforced: imports go down, never up or in a circle."""

import ast
import sys
from collections import Counter
from graphlib import TopologicalSorter

import pytest
from import_graph import FILES, ROOT, code_lines, graph, libraries

FLOORS = {  # from the ground up; rooms of one line do not import each other
    "": """
        sim_configs estimator
        envs evaluation
        agents
        experiments
    """,
    "envs": """
        specs
        drives
        robot random_numbers
        noise_streams controllers
        bearing_range
        spaces rendering
        landmark_world
        vector
    """,
    "estimator": """
        guards
        models
        beliefs
        interface
        kernels
        association
        filters
        map_management
        large_maps peers
        registry
        smoother
        covariance_checks
        check_estimator
    """,
    "estimator.large_maps": """
        undo
        multifrontal
        elimination
        compressed sparse_information submaps
    """,
    "evaluation": """
        hypothesis_tests sequential_tests trajectory_error error_bound
        association_scores
        nees noise_findings map_consistency
        diagnosis
        consistency_report
    """,
    "experiments": """
        logs progress_bar environment_variables
        run_and_replay
        figures job_folders
        viewers
        monte_carlo_study
        noise_study noise_fitting noise_explorer
        trajectories
        estimate_conventions estimate_files log_conventions
        judging space_poses consistency_protocol
        command_line
    """,
    "experiments.monte_carlo_study": """
        filtered_runs
        run_measures
        results
        verdict
        looks
        runner
        summary
        figures
        report
    """,
}
STRANGERS = {
    ("envs", "estimator"),
    ("envs", "evaluation"),
    ("estimator", "sim_configs"),
}
EVALUATION_KNOWS = {"models", "guards", "beliefs", "interface", "filters"}
MAY_IMPORT = {  # besides the standard library
    "sim_configs": {"numpy", "pydantic", "pydantic_core"},
    "envs": {"numpy", "scipy", "gymnasium", "pymunk"},
    "estimator": {"numpy", "scipy", "numba"},
    "evaluation": {"numpy", "scipy"},
    "agents": {"numpy", "scipy", "gymnasium"},
}
DRAWING = {"scene", "renderer", "video"}
DRAWING_LIBRARIES = {"matplotlib", "PIL", "imageio_ffmpeg"}
A_FILE_EACH = (  # folders whose modules stand alone however small, and why
    "experiments.command_line",  # a command each
    "experiments.logs.importers",  # a format each
    "estimator.peers",  # a library each: only such a module may import it
)


def room_in(house, module):
    """Return the room of a house that a module stands in, "" for none or the house."""
    inside = module.removeprefix(house).removeprefix(".") if house else module
    belongs = not house or module.startswith(f"{house}.")
    return inside.split(".")[0] if belongs else ""


def floor_of(house):
    return {
        room: floor
        for floor, line in enumerate(FLOORS[house].strip().splitlines())
        for room in line.split()
    }


def imports_between_rooms(house):
    """Yield (module, imported module, room, imported room) inside a house."""
    for module, targets in graph().items():
        for target in targets:
            room, other = room_in(house, module), room_in(house, target)
            if room and other and room != other:
                yield module, target, room, other


@pytest.mark.parametrize("house", FLOORS, ids=lambda house: house or "slamgym")
def test_imports_only_go_down(house):
    floor = floor_of(house)
    climbing = [
        f"{module} imports {target}"
        for module, target, room, other in imports_between_rooms(house)
        if floor[room] <= floor[other]
    ]
    assert climbing == []


@pytest.mark.parametrize("house", FLOORS, ids=lambda house: house or "slamgym")
def test_every_room_stands_on_a_floor(house):
    rooms = {room_in(house, module) for module in FILES} - {""}
    assert rooms == set(floor_of(house))


def test_worlds_and_estimators_do_not_know_each_other():
    met = {(room, other) for _, _, room, other in imports_between_rooms("")}
    assert not met & (STRANGERS | {(b, a) for a, b in STRANGERS})


def test_evaluation_knows_little_of_the_estimators():
    known = {
        room_in("estimator", target)
        for module, targets in graph().items()
        if room_in("", module) == "evaluation"
        for target in targets
    }
    assert known - {""} <= EVALUATION_KNOWS


def test_no_module_imports_itself_through_others():
    assert list(TopologicalSorter(graph()).static_order())


def may_import(module):
    """Return the libraries that a module may import, or None for any."""
    room = room_in("", module)
    if room not in MAY_IMPORT:
        return None
    more = set(sys.stdlib_module_names)
    if module.removeprefix("envs.rendering.") in DRAWING:
        more |= DRAWING_LIBRARIES
    if module.startswith("estimator.peers."):
        more |= {"gtsam"} & {module.split(".")[-1].split("_")[0]}  # that of its name
    return MAY_IMPORT[room] | more


def test_a_module_imports_only_the_libraries_of_its_layer():
    allowed = {module: may_import(module) for module in FILES}
    strange = {
        module: libraries(module) - known
        for module, known in allowed.items()
        if known is not None
    }
    assert {module: found for module, found in strange.items() if found} == {}


def test_no_room_imports_a_module_that_needs_a_peer():
    needs_one = {module for module in FILES if "gtsam" in libraries(module)}
    importing = {m for m, targets in graph().items() if targets & needs_one}
    assert needs_one
    assert importing <= needs_one


def test_modules_are_imported_relatively_inside_the_package():
    assert [module for module in FILES if "slamgym" in libraries(module)] == []


def test_a_small_module_with_one_importer_is_part_of_it():
    importers = {
        module: [other for other, targets in graph().items() if module in targets]
        for module in FILES
    }
    crumbs = {
        module: importers[module]
        for module, file in FILES.items()
        if file.name != "__init__.py"
        and not module.startswith(A_FILE_EACH)
        and len(importers[module]) == 1
        and code_lines(module) < 60
    }
    assert crumbs == {}


def test_a_class_name_is_defined_once():
    files = [*FILES.values(), *(ROOT / "src" / "slamgym").glob("*.py")]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text()))]
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    assert {name: count for name, count in names.items() if count > 1} == {}


def test_the_links_of_the_package_reach_every_folder():
    links = {
        link.name for link in (ROOT / "src" / "slamgym").iterdir() if link.is_dir()
    }
    assert links - {"__pycache__"} == set(floor_of(""))
