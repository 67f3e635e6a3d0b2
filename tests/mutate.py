"""Mutation testing: make one mistake at a time, and see which tests notice.

::

    python tests/mutate.py --sample 400            # mutants drawn from all rooms
    python tests/mutate.py evaluation/nees.py      # all mutants of a file
    python tests/mutate.py --again                 # those that survived last time

Each mutant runs the tests that TESTS names for its file, in a process of its own that
loads the changed text in place of the file; no file is written. The kernels of PLAIN
run as plain Python, and others that a mutant changes are compiled anew. If it survives
them, all kernels are compiled, and the tests with the mark slow and the examples in the
file judge it, too. A test that fails must pass without the mutant.

Verdicts are kept in ``results/mutants.jsonl``, and a stopped run continues where it
was. The mutants that survive are listed; those in ``mutants_explained.txt`` have no
effect that matters, for the reason given there. mutmut and cosmic-ray write each mutant
to disk and start Python and numba anew, which would take most of the time here.
"""

import argparse
import importlib.machinery
import json
import os
import random
import resource
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests" / "support")]

import pytest  # noqa: E402
from mutants import Mutant, mutants_of  # noqa: E402


class Tests(NamedTuple):
    """What judges the mutants of a file, and whether kernels run as plain Python."""

    files: tuple[str, ...]
    plain: bool = False
    slow: bool = False  # whether also those that carry this mark


SCANS = "association decisions symmetries map_management hypotheses loop_closing"
LARGE = "estimator/large_maps"
STUDY = "experiments/monte_carlo_study"
#: The first tests notice most; those of the longest beginning of a path count.
TESTS = {
    "agents/": "active_slam information_reward belief_observation",
    "agents/active_slam": (
        "active_slam active_slam_pass active_slam_hidden active_slam_honesty"
    ),
    "agents/active_slam_baselines": "planners wall_routes active_slam",
    "agents/active_slam_scores": "active_slam active_slam_honesty active_slam_hidden",
    "agents/active_slam_task": "active_slam active_slam_pass landmark_set",
    "agents/belief_": "belief_observation information_reward state_and_restore",
    "agents/belief_space_planner": "planners wall_routes active_slam",
    "agents/landmark_set": "landmark_set belief_observation",
    "agents/wall_routes": "planners wall_routes active_slam",
    "envs/": "landmark_world streams world_batch models_of_worlds",
    "envs/bearing_range": (
        "bearing_range_sensor world_batch landmark_world simulated_runs "
        "models_of_worlds faults"
    ),
    "envs/controllers": "controllers vector_controllers drawn_worlds",
    "envs/landmark_world": (
        "landmark_world streams models_of_worlds drawn_worlds pose_sensors "
        "state_and_restore"
    ),
    "envs/noise_streams": "bearing_range_sensor streams pose_sensors faults",
    "envs/random_numbers": "streams bearing_range_sensor drawn_worlds",
    "envs/rendering": "rendering ellipses",
    "envs/rendering/episode_renderer": "landmark_world state_and_restore",
    "envs/rendering/video": "video",
    "envs/spaces": "faults landmark_world drawn_worlds models_of_worlds world_batch",
    "envs/specs": "gymnasium_contract every_environment",
    "envs/robot": "unicycle_body world_batch landmark_world models_of_worlds faults",
    "envs/vector": (
        "landmark_world_vector world_batch vector_controllers pose_sensors "
        "drawn_worlds state_and_restore models_of_worlds"
    ),
    "envs/vector/wrappers": "landmark_world_vector stable_baselines",
    "estimator/": "ekf_slam filter_family errors_change_nothing",
    "estimator/models/bearing_range": "motions bearing_range ekf_slam",
    "estimator/models/relative_geometry": "relative_geometry",
    "estimator/models/rigid_motion": (
        "error_frames nees submaps joining ekf_slam filter_family"
    ),
    "estimator/models/motions": "motions ekf_slam",
    "estimator/models/model_checks": "sensors motions",
    "estimator/models/sensor": "sensors",
    "estimator/beliefs": "representations relative_geometry map_editor saved_states",
    "estimator/check_estimator": "check_estimator",
    "estimator/covariance_checks": "check_estimator",
    "estimator/kernels/assignment_search": "joint_assignment constellations",
    "estimator/kernels/batch": "batch error_bound",
    "estimator/kernels/imagine": "imagine association map_management",
    "estimator/kernels/sizes_of_covariances": "imagine",
    "estimator/kernels/scan_update": (
        "ekf_slam filter_family association joint_assignment map_management"
    ),
    "estimator/filters/batch": "batch imagine",
    "estimator/filters/delayed_landmarks": "sensors saved_states",
    "estimator/filters/drive_likelihood": "drive_likelihood",
    "estimator/filters/ekf": (
        "ekf_slam filter_family sensors pose_readings errors_change_nothing"
    ),
    "estimator/filters/imagine": "imagine",
    "estimator/filters/pose_readings": "pose_readings map_editor loop_closing",
    "estimator/filters/gaussian_map": (
        "ekf_slam filter_family filter_memory map_management"
    ),
    "estimator/association": f"{SCANS} joint_assignment missed_detections",
    "estimator/association/constellations": "constellations loop_closing",
    "estimator/association/missed_landmarks": "missed_detections map_management",
    "estimator/guards": "saved_states errors_change_nothing magnitudes",
    "estimator/interface": (
        "representations ekf_slam pose_readings check_estimator errors_change_nothing "
        "map_management"
    ),
    "estimator/map_management": f"{SCANS} missed_detections map_editor",
    "estimator/map_management/clear_scans": "clear_scans map_management",
    "estimator/map_management/recent_scans": f"{SCANS} clear_scans",
    "estimator/map_management/map_editor": "map_editor map_management loop_closing",
    f"{LARGE}/compressed": "compressed large_maps errors_change_nothing",
    f"{LARGE}/elimination": "submaps sparse_information smoother",
    f"{LARGE}/multifrontal": "sparse_information",
    f"{LARGE}/sparse_information": (
        "sparse_information large_maps errors_change_nothing"
    ),
    f"{LARGE}/submaps": (
        "submaps submap_editing joining large_maps errors_change_nothing sensors"
    ),
    "estimator/peers": "peers",
    "estimator/registry": (
        "representations models_of_logs filter_family ekf_slam sensors check_estimator "
        "peers"
    ),
    "estimator/smoother": "smoother reassociation symmetries pose_readings",
    "estimator/smoother/batch_smoother": "smoother reassociation smooth_command",
    "evaluation/association_scores": "association_scores gospa",
    "evaluation/consistency_report": "consistency_report",
    "evaluation/diagnosis": "diagnosis noise_findings",
    "evaluation/error_bound": "error_bound",
    "evaluation/hypothesis_tests": "hypothesis_tests nees consistency_report diagnosis",
    "evaluation/map_consistency": "map_consistency",
    "evaluation/nees": "nees consistency_report",
    "evaluation/noise_findings": "noise_findings diagnosis",
    "evaluation/sequential_tests": "sequential_tests",
    "evaluation/trajectory_error": "trajectory_error",
    "experiments/command_line": "options_of_commands command_line replay generate",
    "experiments/command_line/benchmark": "consistency_protocol options_of_commands",
    "experiments/command_line/commands": "command_line signals progress_bar",
    "experiments/command_line/explore": "noise_explorer options_of_commands",
    "experiments/command_line/fit_noise": (
        "options_of_commands noise_fitting log_conventions"
    ),
    "experiments/command_line/generate": "options_of_commands generate",
    "experiments/command_line/judge": (
        "options_of_commands judging strangers_files space_poses"
    ),
    "experiments/command_line/monte_carlo": (
        "monte_carlo_command options_of_commands monte_carlo_folder monte_carlo_report "
        "monte_carlo"
    ),
    "experiments/command_line/noise_study": (
        "options_of_commands noise_study noise_effects_of_many_runs command_line"
    ),
    "experiments/command_line/options": (
        "options_of_commands command_line replay generate strangers_files"
    ),
    "experiments/command_line/output_folder": "hostile_files signals command_line",
    "experiments/command_line/render_video": "options_of_commands video command_line",
    "experiments/command_line/smooth": "options_of_commands smooth_command",
    "experiments/command_line/tables": (
        "replay monte_carlo_report noise_fitting command_line"
    ),
    "experiments/consistency_protocol": "consistency_protocol",
    "experiments/estimate_conventions": "estimate_conventions judging",
    "experiments/estimate_files": "estimate_files strangers_files judging",
    "experiments/figures": "figures",
    "experiments/figures/smoothed": "smooth_command",
    "experiments/environment_variables": "generate command_line",
    "experiments/job_folders": "monte_carlo_folder generate",
    "experiments/judging": "judging strangers_files",
    "experiments/log_conventions": "log_conventions",
    "experiments/logs": "slamlog importers strangers_files replay pose_rows",
    "experiments/logs/ground_truth": "slamlog replay noise_fitting map_management",
    "experiments/logs/recording": "recording replay pose_rows",
    "experiments/logs/importers": "importers strangers_files log_conventions",
    STUDY: "study_by_hand monte_carlo",
    f"{STUDY}/figures": "monte_carlo_report html_report",
    f"{STUDY}/looks": "looks",
    f"{STUDY}/report": "html_report monte_carlo_report efficiency",
    f"{STUDY}/results": "study_by_hand monte_carlo monte_carlo_folder looks",
    f"{STUDY}/runner": "study_by_hand monte_carlo monte_carlo_folder looks causes",
    f"{STUDY}/summary": "monte_carlo_report efficiency html_report monte_carlo",
    f"{STUDY}/verdict": "monte_carlo_report efficiency causes looks monte_carlo",
    "experiments/noise_explorer": "noise_explorer",
    "experiments/noise_fitting": "noise_fitting",
    "experiments/noise_study": "noise_study noise_effects_of_many_runs progress_bar",
    "experiments/progress_bar": "progress_bar",
    "experiments/run_and_replay": "replay run_warnings trace simulated_runs",
    "experiments/run_and_replay/log_replay": "replay run_warnings map_management",
    "experiments/run_and_replay/log_smoothing": "smooth_command pose_rows",
    "experiments/space_poses": "space_poses",
    "experiments/trajectories": "generate trajectory_formats belief_columns",
    "experiments/trajectories/formats": "trajectory_formats generate",
    "experiments/trajectories/parquet": "trajectory_formats belief_columns",
    "experiments/viewers/rerun_recording": "rerun_recording",
    "experiments/viewers/run_page": "run_page",
    "sim_configs": "scenario layouts controls city randomisation extreme_scenarios",
    "sim_configs/scenario": (
        "scenario randomisation controls models_of_worlds drawn_worlds"
    ),
    "sim_configs/scenario_files": (
        "scenario randomisation drawn_worlds figures hostile_files"
    ),
    "src/slamgym": "public_names kernel_cache leaves scenario",
    "src/slamgym/argument_checks": (
        "errors_change_nothing magnitudes filter_memory hypothesis_tests association "
        "batch nees"
    ),
    "src/slamgym/restorable": "state_and_restore",
    "src/slamgym/suggestions": (
        "scenario command_line check_estimator models_of_worlds"
    ),
}
PLAIN = (
    *("estimator/models", "estimator/kernels", "evaluation/error_bound"),
    *("estimator/filters/drive_likelihood.py", "estimator/filters/gaussian_map.py"),
)
NOT_PLAIN = (  # too slow, about kernels, or Python raises where numba divides by zero
    "not (nees_and_nis or 1000_steps or order_of_readings or gate_keeps or far_beyond "
    "or a_pass_that_fails or exact_reading_of_an or no_kernels or plain_python)"
)
ROOMS = (
    *("agents", "envs", "estimator", "evaluation", "experiments", "sim_configs"),
    "src/slamgym",
)
CPU_SECONDS = 300  # of the tests of a mutant, which then count as endless
OUTCOMES = {0: "survived", 1: "killed", 2: "killed", 4: "killed"}  # 2, 4: at import
DEFAULTS = "tests/contracts/test_defaults.py"
EXPLAINED = Path(__file__).with_name("mutants_explained.txt")
RESULTS = ROOT / "results" / "mutants.jsonl"


def tests_of(file: str) -> Tests:
    """Return the tests of a source file."""
    names = TESTS[entry_of(file)].split()
    files = (test_files()[f"test_{name}.py"] for name in names)
    return Tests(tuple(files), plain=file.startswith(PLAIN))


def entry_of(file: str) -> str:
    """Return the longest entry of the table that begins a path."""
    return max((key for key in TESTS if file.startswith(key)), key=len)


@cache
def test_files() -> dict[str, str]:
    """Return the files of tests by their names."""
    paths = (ROOT / "tests").glob("*/test_*.py")
    return {path.name: path.relative_to(ROOT).as_posix() for path in paths}


def sources(wanted: list[str]) -> Iterator[str]:
    """Yield the files to change, as paths from the root."""
    for room in ROOMS:
        found = (ROOT / room).glob("*.py" if "/" in room else "**/*.py")
        for path in sorted(found):
            file = path.relative_to(ROOT).as_posix()
            if not path.name.startswith("__") and (
                not wanted or any(w in file for w in wanted)
            ):
                yield file


@cache
def source_of(file: str) -> str:
    """Return a file's text, which may not change while its mutants run."""
    return (ROOT / file).read_text()


def preload() -> None:
    """Load what every test loads, other than slamgym itself."""
    import numba  # noqa: F401
    import numpy.testing  # noqa: F401
    import scipy.linalg
    import scipy.optimize
    import scipy.sparse.linalg
    import scipy.spatial
    import scipy.stats  # noqa: F401


def all_tests_of(file: str) -> Tests:
    """Return what judges the mutants that survive the other tests of a file."""
    examples = f"src/slamgym/{file.removeprefix('src/slamgym/')}"
    return Tests((examples, *tests_of(file).files, DEFAULTS), slow=True)


def verdict(tests: Tests, file: str = "", text: str = "", function: str = "") -> str:
    """Run tests with another text of a file: killed, survived, or timeout.

    The test that fails must pass without the mutant, and one must run; else the verdict
    is broken.
    """
    code, failed = _in_a_fork(tests, file, text, function)
    alone = tests._replace(files=(failed,))
    if code == pytest.ExitCode.TESTS_FAILED and not _passes(alone):
        return "broken"
    return "timeout" if code < 0 else OUTCOMES.get(code, "broken")


def _in_a_fork(
    tests: Tests, file: str = "", text: str = "", function: str = ""
) -> tuple[int, str]:
    """Run tests in a fork; return the exit code, and the test that fails, if any.

    A kernel that is changed, and those that call it, are compiled anew.
    """
    with tempfile.NamedTemporaryFile("r") as failed:
        child = os.fork()
        if not child:
            try:
                os.setsid()
                _run(tests, file, text, function, failed.name)
            finally:
                os._exit(pytest.ExitCode.INTERNAL_ERROR)
        began = time.monotonic()
        while not (ended := os.waitpid(child, os.WNOHANG))[0]:
            if time.monotonic() - began > 3 * CPU_SECONDS:
                os.killpg(child, signal.SIGKILL)
            time.sleep(0.02)
        return os.waitstatus_to_exitcode(ended[1]), failed.read()


@cache
def _passes(tests: Tests) -> bool:
    """Whether tests pass without a mutant."""
    return _in_a_fork(tests)[0] == pytest.ExitCode.OK


class _Notes:
    """Write the name of the test that fails to a file; note whether any passes."""

    def __init__(self, file: str) -> None:
        self._file, self.is_tested = Path(file), False

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the outcome of a test."""
        self.is_tested |= report.when == "call" and report.passed
        if report.failed:
            self._file.write_text(report.nodeid)


def _run(tests: Tests, file: str, text: str, function: str, failed: str) -> None:
    import numba

    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    numba.config.DISABLE_JIT = tests.plain
    if tests.plain:
        os.environ["NUMBA_DISABLE_JIT"] = "1"
    if file:
        _load_instead(ROOT / file, text)
        _compile_anew(file, function)
    os.chdir(ROOT)
    # matplotlib compares this thread with the main one, whose number a fork keeps.
    threading.main_thread()._set_native_id()
    # pytest would rewrite the assertions of a file that is named, from the disk.
    options = ["-x", "-q", "-p", "no:cacheprovider", "--tb=no", "--assert=plain"]
    options += [] if tests.slow else ["-m", "not slow"]
    options += ["-k", NOT_PLAIN] if tests.plain else []
    notes = _Notes(failed)
    code = pytest.main([*options, *tests.files], [notes])
    if code == pytest.ExitCode.OK and not notes.is_tested:  # a library is missing
        code = pytest.ExitCode.NO_TESTS_COLLECTED
    os._exit(int(code))


def _load_instead(path: Path, text: str) -> None:
    """Let the import system compile another text in place of a file's."""
    loader = importlib.machinery.SourceFileLoader
    usual = loader.get_code

    def get_code(self, fullname):
        if Path(self.path).resolve() == path:
            return compile(text, self.path, "exec")
        return usual(self, fullname)

    loader.get_code = get_code


def _compile_anew(file: str, function: str) -> None:
    """Load no kernel that calls the changed one, or has a changed constant."""
    from slamgym.jit import KernelCache

    module = f"slamgym.{file.removeprefix('src/slamgym/')[:-3].replace('/', '.')}"

    @cache
    def reaches(kernel: object) -> bool:
        own, names = kernel.py_func, kernel.py_func.__code__.co_names
        called = (own.__globals__.get(name) for name in names)
        return (own.__module__ == module and function in ("", own.__name__)) or any(
            reaches(each) for each in called if hasattr(each, "py_func")
        )

    usual = KernelCache._files.func
    KernelCache._files = property(
        lambda self: None if reaches(self._kernel) else usual(self)
    )


def drawn(arguments: argparse.Namespace) -> list[tuple[str, Mutant]]:
    """Return the mutants to run: a sample, or all, or those that survived."""
    every = [
        (file, mutant)
        for file in sources(arguments.files)
        for mutant in mutants_of(source_of(file))
    ]
    print(f"{len(every)} mutants of {len({file for file, _ in every})} files")
    if arguments.again:
        before = verdicts()
        return [m for m in every if before.get(key_of(*m)) == "survived"]
    random.Random(arguments.seed).shuffle(every)
    return every[: arguments.sample]


def verdicts() -> dict[tuple[str, ...], str]:
    """Return what earlier runs found, the last word on each mutant."""
    lines = RESULTS.read_text().splitlines() if RESULTS.exists() else []
    return {tuple(each["key"]): each["verdict"] for each in map(json.loads, lines)}


def key_of(file: str, mutant: Mutant) -> tuple[str, str, str, str]:
    """Return what names a mutant when lines have moved."""
    text = mutant.described(source_of(file))
    line = source_of(file).splitlines()[mutant.line - 1].strip()
    return (file, mutant.function, line, text)


@cache
def explained() -> dict[str, str]:
    """Return the reasons for survivors, by ``file:function: change``."""
    pairs = {}
    for line in EXPLAINED.read_text().splitlines():
        if line and not line.startswith("#"):
            name, _, reason = line.rpartition(" | ")
            pairs[name.strip()] = reason.strip()
    return pairs


def main() -> int:
    """Run mutants, print a table, and list those that survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", help="parts of paths; all by default")
    parser.add_argument("--sample", type=int, help="how many; all by default")
    parser.add_argument("--seed", type=int, default=0, help="which ones")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after them")
    parser.add_argument("--again", action="store_true", help="survivors of last time")
    parser.add_argument("--fresh", action="store_true", help="also those once killed")
    arguments = parser.parse_args()
    os.environ |= {
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT / "src"),
        "HYPOTHESIS_STORAGE_DIRECTORY": tempfile.mkdtemp(),
    }
    preload()
    mutants = drawn(arguments)
    earlier = {} if arguments.again or arguments.fresh else verdicts()
    counts: Counter[tuple[str, str]] = Counter()
    began = time.monotonic()
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("a") as results:
        for file, mutant in mutants:
            if time.monotonic() - began > 60 * arguments.minutes:
                break
            outcome = earlier.get(key_of(file, mutant), "")
            if outcome not in ("killed", "timeout"):
                outcome = _judged(file, mutant)
                line = {"key": key_of(file, mutant), "verdict": outcome}
                results.write(json.dumps(line) + "\n")
                results.flush()
            counts[os.path.dirname(file), outcome] += 1
    _print(counts, time.monotonic() - began)
    return 1 if any(outcome == "survived" for _, outcome in counts) else 0


def _judged(file: str, mutant: Mutant) -> str:
    """Run the tests of one mutant; print it if it survives."""
    tests, changed = tests_of(file), mutant.applied(source_of(file))
    try:
        compile(changed, file, "exec")
    except SyntaxError:
        return "broken"
    outcome = verdict(tests, file, changed, mutant.function)
    if outcome != "survived":
        return outcome
    if verdict(all_tests_of(file), file, changed, mutant.function) == "killed":
        return "killed"
    _, function, line, change = key_of(file, mutant)
    if f"{file}:{function}: {change}" in explained():
        return "explained"
    print(f"{file}:{mutant.line}:{function}: {change}   in   {line}", flush=True)
    return outcome


def _print(counts: Counter[tuple[str, str]], seconds: float) -> None:
    kinds = ("killed", "timeout", "explained", "survived", "broken")
    print(f"\n{'folder':32}" + "".join(f"{kind:>10}" for kind in kinds) + "  noticed")
    for folder in sorted({folder for folder, _ in counts}):
        _print_row(folder, [counts[folder, kind] for kind in kinds])
    total = [sum(n for (_, k), n in counts.items() if k == kind) for kind in kinds]
    _print_row(f"all, in {seconds:.0f} s", total)


def _print_row(name: str, numbers: list[int]) -> None:
    """Print numbers by outcome, and the share noticed with Wilson's 95 % interval."""
    from scipy.stats import binomtest

    noticed, judged = sum(numbers[:2]), sum(numbers[:4])
    low, high = binomtest(noticed, max(judged, 1)).proportion_ci(method="wilson")
    shares = f"{noticed} of {judged}, {low:.0%} to {high:.0%}"
    print(f"{name:32}" + "".join(f"{n:10}" for n in numbers) + f"  {shares}")


if __name__ == "__main__":
    sys.exit(main())
