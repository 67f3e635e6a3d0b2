"""The command for mutation testing knows the tests of every file it changes."""

import sys
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


def test_every_file_has_tests(mutate):
    files = list(mutate.sources([]))
    assert len(files) > 15
    for file in files:
        for tests in mutate.tests_of(file).files:
            assert (ROOT / tests).is_file(), (file, tests)


def test_explanations_are_of_functions_that_exist(mutate):
    for place in mutate.explained():
        file, function, _ = place.split(":", 2)
        assert f"def {function}(" in (ROOT / file).read_text() or not function, place
