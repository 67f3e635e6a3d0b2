"""The command for mutation testing knows the tests of every file it changes."""

import os
import subprocess
import sys
from glob import glob
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def mutate(monkeypatch):
    for folder in ("tests", "tests/support"):
        monkeypatch.syspath_prepend(str(ROOT / folder))
    import mutate

    yield mutate
    for name in ("mutate", "mutants"):
        sys.modules.pop(name, None)


def test_every_file_of_the_library_has_tests(mutate):
    package = ROOT / "src" / "slamgym"
    files = {(ROOT / file).resolve() for file in mutate.sources([])}
    every = {
        path.resolve() for path in map(Path, glob(f"{package}/**/*.py", recursive=True))
    }
    assert files == {path for path in every if not path.name.startswith("__")}
    assert all(mutate.tests_of(file).files for file in mutate.sources([]))


def test_every_entry_of_the_table_is_used(mutate):
    for entry, names in mutate.TESTS.items():
        files = [file for file in mutate.sources([]) if file.startswith(entry)]
        used = [file for file in files if mutate.entry_of(file) == entry]
        assert used, entry
        assert len(set(names.split())) == len(names.split()), entry


SOURCE = """
class Pose:
    x: float
    y: float


def turned(pose, end: float, start: float, way=True):
    a, b = pose.x, pose.copy()
    way = way and a < b[end:]
    return swapped(a, b, end + 1) if way else b[row - 1]
"""
MISTAKES = {
    "way=False",
    "= pose.y, pose.copy()",
    "pose.x, (pose)",
    "and a <= b[end:]",
    "and b < b[end:]",
    "b[start:]",
    "b[end + 1:]",
    "swapped(b, a, end + 1)",
    "swapped(a, b, end)",
    "b[row]",
}


def test_mistakes_are_those_that_a_hand_makes(mutate):
    import mutants

    every = mutants.mutants_of(SOURCE)
    changed = [" ".join(m.applied(SOURCE).split()) for m in every]
    for mistake in MISTAKES:
        assert sum(mistake in text for text in changed) == 1, mistake


def test_explanations_are_of_functions_that_exist(mutate):
    for place in mutate.explained():
        file, function, _ = place.split(":", 2)
        assert f"def {function}(" in (ROOT / file).read_text() or not function, place


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the tool forks")
@pytest.mark.parametrize(
    ("body", "verdict"),
    [("assert False", "broken"), ("pytest.skip()", "broken"), ("pass", "survived")],
)
def test_tests_that_fail_anyway_or_are_skipped_judge_no_mutant(
    mutate, body, verdict, tmp_path
):
    file = tmp_path / "test_it.py"
    file.write_text(f"import pytest\n\n\ndef test_it():\n    {body}\n")
    assert mutate.verdict(mutate.Tests((str(file),))) == verdict


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the tool forks")
def test_what_survives_is_judged_by_slow_tests_and_by_examples(mutate, tmp_path):
    file = "src/slamgym/suggestions.py"
    tests = mutate.all_tests_of(file)
    assert {*mutate.tests_of(file).files} < {*tests.files}
    assert mutate.verdict(tests._replace(files=(tests.files[0],))) == "survived"
    slow = tmp_path / "test_it.py"
    slow.write_text("import pytest\n\n\n@pytest.mark.slow\ndef test_it():\n    pass\n")
    assert mutate.verdict(mutate.Tests((str(slow),))) == "broken"  # none ran
    assert mutate.verdict(tests._replace(files=(str(slow),))) == "survived"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the tool forks")
def test_an_example_in_a_file_sees_the_changed_text():
    code = """
import sys
sys.path.insert(0, "tests")
import mutate
file = "src/slamgym/suggestions.py"
examples = mutate.all_tests_of(file).files[0]
tests, text = mutate.Tests((examples,), slow=True), mutate.source_of(file)
changed = text.replace("_SIMILAR = 0.6", "_SIMILAR = 0.99")
sys.stderr.write(f"{mutate.verdict(tests)} {mutate.verdict(tests, file, changed)}")
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stderr.endswith("survived killed")
