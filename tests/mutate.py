"""Mutation testing: make one mistake at a time, and see which tests notice.

::

    python tests/mutate.py --sample 400            # mutants drawn from all rooms
    python tests/mutate.py evaluation/nees.py      # all mutants of a file
    python tests/mutate.py --again                 # those that survived last time

Each mutant runs the tests that TESTS names for its file, in a process of its own that
loads the changed text in place of the file; no file is written.  Kernels run as plain
Python.  Verdicts are kept in ``results/mutants.jsonl``, and a stopped run goes on where
it was.  The mutants that survive are listed; those in ``mutants_explained.txt`` change
nothing that counts, for the reason that stands beside them.  mutmut and cosmic-ray
write each mutant to disk and start Python and numba anew, most of the time here.
"""

import argparse
import importlib.machinery
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests" / "support")]

from mutants import Mutant, mutants_of  # noqa: E402

ESTIMATOR, EVALUATION = "tests/estimator/test_", "tests/evaluation/test_"


class Tests(NamedTuple):
    """What judges the mutants of a file, and whether kernels run as plain Python."""

    files: tuple[str, ...]
    plain: bool = False


def _of(folder: str, names: str, *, plain: bool = False) -> Tests:
    return Tests(tuple(f"{folder}{name}.py" for name in names.split()), plain)


FILTERS = "ekf_slam filter_family"
SCANS = "association decisions map_management hypotheses loop_closing"
TESTS = {
    "estimator/models/bearing_range": "motions bearing_range ekf_slam",
    "estimator/models/relative_geometry": "relative_geometry",
    "estimator/models/rigid_motion": "error_frames submaps joining ekf_slam",
    "estimator/models/motions": "motions ekf_slam",
    "estimator/models/model_checks": "sensors motions",
    "estimator/models/sensor": "sensors",
    "estimator/kernels/assignment_search": "joint_assignment constellations",
    "estimator/kernels/batch": "batch",
    "estimator/filters/drive_likelihood": "drive_likelihood",
    "estimator/kernels/imagine": "imagine association map_management",
    "estimator/kernels/sizes_of_covariances": "imagine",
    "estimator/kernels/scan_update": (
        f"{FILTERS} association joint_assignment map_management"
    ),
    "estimator/kernels": FILTERS,
    "estimator/filters/gaussian_map": f"{FILTERS} filter_memory map_management",
    "estimator/association/constellations": "constellations loop_closing",
    "estimator/association": f"{SCANS} joint_assignment",
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
}
KERNELS = ("estimator/filters/drive_likelihood.py", "estimator/filters/gaussian_map.py")
PLAIN = ("estimator/models", "estimator/kernels", "evaluation/error_bound", *KERNELS)
NOT_PLAIN = (  # too slow as plain Python, or Python raises where numba divides by zero
    "not (nees_and_nis or 1000_steps or order_of_readings or gate_keeps or far_beyond "
    "or a_pass_that_fails)"
)
FOLDERS = ("models", "kernels", "association")
ROOMS = (*(f"estimator/{name}" for name in FOLDERS), *KERNELS, "evaluation")
EXPLAINED = Path(__file__).with_name("mutants_explained.txt")
RESULTS = ROOT / "results" / "mutants.jsonl"


def tests_of(file: str) -> Tests:
    """Return the tests of a source file, as the longest entry of the table says."""
    entry = max((key for key in TESTS if file.startswith(key)), key=len)
    folder = ESTIMATOR if file.startswith("estimator") else EVALUATION
    return _of(folder, TESTS[entry], plain=file.startswith(PLAIN))


def sources(wanted: list[str]) -> Iterator[str]:
    """Yield the files to change, as paths from the root."""
    for room in ROOMS:
        for path in sorted((ROOT / room).glob("*.py")) or [ROOT / room]:
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
    import pytest  # noqa: F401
    import scipy.linalg
    import scipy.optimize
    import scipy.sparse.linalg
    import scipy.spatial
    import scipy.stats  # noqa: F401


def verdict(tests: Tests, file: str = "", text: str = "", limit: float = 600.0) -> str:
    """Run tests in a fork, with another text of a file: killed, survived, or timeout.

    A mutant that cannot be loaded counts as broken: it tells nothing about the tests.
    """
    child = os.fork()
    if not child:
        os.setsid()
        _run(tests, file, text)
    began = time.monotonic()
    while time.monotonic() - began < limit:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            return "survived" if code == 0 else "killed"
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "timeout"


def _run(tests: Tests, file: str, text: str) -> None:
    import numba
    import pytest

    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    numba.config.DISABLE_JIT = tests.plain
    if tests.plain:
        os.environ["NUMBA_DISABLE_JIT"] = "1"
    if file:
        _load_instead(ROOT / file, text)
    os.chdir(ROOT)
    options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", "--tb=no"]
    options += ["-k", NOT_PLAIN] if tests.plain else []
    code = pytest.main([*options, *tests.files])
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
            counts[file, outcome] += 1
    _print(counts, time.monotonic() - began)
    return 1 if any(outcome == "survived" for _, outcome in counts) else 0


def _judged(file: str, mutant: Mutant) -> str:
    """Run the tests of one mutant; print it if it survives."""
    tests, changed = tests_of(file), mutant.applied(source_of(file))
    try:
        compile(changed, file, "exec")
    except SyntaxError:
        return "broken"
    outcome = verdict(tests, file, changed, _time_allowed(tests))
    if outcome != "survived":
        return outcome
    _, function, line, change = key_of(file, mutant)
    if f"{file}:{function}: {change}" in explained():
        return "explained"
    print(f"{file}:{mutant.line}:{function}: {change}   in   {line}", flush=True)
    return outcome


@cache
def _time_allowed(tests: Tests) -> float:
    """Return how long a mutant may take; the tests must pass without one."""
    began = time.monotonic()
    if verdict(tests) != "survived":
        sys.exit(f"these tests fail without a mutant: {' '.join(tests.files)}")
    return 20 + 5 * (time.monotonic() - began)


def _print(counts: Counter[tuple[str, str]], seconds: float) -> None:
    kinds = ("killed", "timeout", "explained", "survived", "broken")
    print(f"\n{'file':44}" + "".join(f"{kind:>10}" for kind in kinds))
    for room in ROOMS:
        for file in sorted({f for f, _ in counts if f.startswith(room)}):
            print(f"{file:44}" + "".join(f"{counts[file, k]:10}" for k in kinds))
    total = {k: sum(n for (_, kind), n in counts.items() if kind == k) for k in kinds}
    print(f"{'all':44}" + "".join(f"{total[k]:10}" for k in kinds))
    noticed, ran = total["killed"] + total["timeout"], sum(total.values())
    judged = max(ran - total["broken"], 1)
    print(f"{noticed} of {judged} killed, {noticed / judged:.1%}, in {seconds:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
