"""What the documents say is so: their code runs, their commands work, links resolve."""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from import_graph import PACKAGES

import slamgym
from slamgym.estimator import list_estimators, make_estimator
from slamgym.sim_configs import list_presets, load_scenario

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
START = (ROOT / "docs" / "start.md").read_text()
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *sorted(ROOT.glob("docs/*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$(?:\n\n^```text\n(.*?)^```$)?", re.M | re.S)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def name_of(document):
    return str(document.relative_to(ROOT))


def blocks(text, language):
    """Yield (code, expected output or empty) of each block in a language."""
    for found in BLOCK.finditer(text):
        if found[1] == language:
            yield found[2], found[3] or ""


def commands(text):
    """Yield the lines of the bash blocks."""
    for code, _ in blocks(text, "bash"):
        yield from code.splitlines()


PYTHON = [
    pytest.param(code, output, id=f"{name_of(document)}-{number}")
    for document in DOCUMENTS
    for number, (code, output) in enumerate(blocks(document.read_text(), "python"), 1)
]
FIRST_LINE = next(commands(README))
MAIN_JOB = FIRST_LINE.rpartition(" && ")[2]


@pytest.fixture(scope="module")
def first_run(tmp_path_factory):
    """Return the folder in which a reader has typed the README's main command."""
    folder = tmp_path_factory.mktemp("reader")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        from slamgym.experiments.command_line.app import main

        with pytest.raises(SystemExit) as end:
            main(shlex.split(MAIN_JOB)[1:])
    assert end.value.code in (0, None)
    return folder / "results" / "first_run"


@pytest.fixture
def reader(first_run, tmp_path, monkeypatch, own_registry):
    """Stand where a reader stands: in a folder with a first run and some drive.csv."""
    shutil.copytree(first_run, tmp_path / "results" / "first_run")
    shutil.copy(first_run / "log.csv", tmp_path / "drive.csv")
    example = ROOT / "examples" / "05_your_own_estimator.py"
    shutil.copy(example, tmp_path / "my_filters.py")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    noise = {"motion_std": (0.25, 0.1, 0.1), "measurement_std": (0.01, 0.08)}
    return {"__name__": "reader", "estimator": make_estimator("ekf", **noise)}


@pytest.mark.slow
@pytest.mark.parametrize(("code", "output"), PYTHON)
def test_python_in_a_document_runs_and_prints_what_it_shows(
    code, output, reader, capsys
):
    exec(compile(code, "document", "exec"), reader)
    printed = capsys.readouterr().out
    assert not output or printed == output


@pytest.mark.parametrize(("code", "output"), PYTHON)
def test_a_filter_in_a_document_has_the_noise_of_its_world(code, output):
    calls = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call)]
    given = {k.arg: k.value for call in calls for k in call.keywords}
    named = [
        call.args[0] for call in calls if ast.unparse(call.func) == "load_scenario"
    ]
    for world in {*named, given.get("scenario")} - {None}:
        if isinstance(world, ast.Constant) and world.value in list_presets():
            known = load_scenario(world.value)
            for part in ("motion", "sensor"):
                std = given.get(f"{part.replace('sensor', 'measurement')}_std")
                if isinstance(std, ast.Tuple):
                    assert ast.literal_eval(std) == getattr(known, part).std


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coarse_loop", "differential", "position"])
def test_the_loop_of_the_readme_fits_every_world(name, capsys):
    loop = next(code for code, _ in blocks(README, "python") if "gym.make" in code)
    exec(loop.replace('"corridor"', f'"{name}"'), {})
    assert float(capsys.readouterr().out.split()[0]) < 1.5


def test_the_three_uses_fit_into_fifteen_lines_each():
    uses = README.split("## Three uses")[1].split("\n## ")[0]
    lengths = [
        sum(bool(line.strip()) for line in code.splitlines())
        for code, _ in blocks(uses, "python")
    ]
    assert len(lengths) == 3
    assert max(lengths) <= 15


@pytest.mark.slow
def test_the_main_job_writes_what_the_documents_promise(first_run):
    section = START.split("## What a run writes")[1].split("\n## ")[0]
    table = [line for line in section.splitlines() if line.startswith("| `")]
    promised = {name for line in table for name in re.findall(r"`([^`]+)`", line)}
    found = {entry.name + "/" * entry.is_dir() for entry in first_run.iterdir()}
    assert promised == found


def known_commands():
    from slamgym.experiments.command_line.app import main

    return {c.name or c.callback.__name__ for c in main.registered_commands}


def test_the_readme_lists_all_commands():
    table = README.split("## Commands")[1].split("\n## ")[0]
    assert set(re.findall(r"^\| `slamgym ([\w-]+)", table, re.M)) == known_commands()


def test_the_filter_page_lists_all_filters():
    page = (ROOT / "docs" / "filters.md").read_text()
    assert set(re.findall(r"^## `(\w+)`$", page, re.M)) == set(list_estimators())


def test_every_command_in_a_document_is_known():
    for document in DOCUMENTS:
        typed = re.findall(r"`slamgym ([a-z-]+)", document.read_text())
        assert set(typed) <= known_commands(), name_of(document)


def test_scenarios_named_in_commands_exist():
    named = re.findall(r"slamgym (?:run|render|noise-study) (\w+)\b(?!\.)", README)
    assert set(named) - {"SCENARIO"} <= set(list_presets())


def anchors(document):
    """Return the anchors of a document's headings, as code hosts make them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_relative_links_resolve():
    for document in DOCUMENTS:
        for link in LINK.findall(document.read_text()):
            if re.match(r"https?://|learn/|generated/", link):
                continue  # the last two are made by sphinx-build, which checks them
            path, _, anchor = link.partition("#")
            target = document.parent / path if path else document
            assert target.exists(), (name_of(document), link)
            assert not anchor or anchor in anchors(target), (name_of(document), link)


NAMED_FILE = re.compile(r"`((?:[\w.]+/)+[\w.-]+\.\w+)`|python ((?:[\w]+/)+\w+\.py)")


def test_files_named_in_documents_exist_and_links_lead_to_the_module_they_name():
    entries = {entry.name for entry in ROOT.iterdir()} - {"results"}  # of a user
    for document in DOCUMENTS:
        text = document.read_text()
        names = {name for pair in NAMED_FILE.findall(text) for name in pair if name}
        for name in names:
            inside = name.split("/")[0] in entries
            assert (ROOT / name).exists() or not inside, (name_of(document), name)
        for name, path in re.findall(r"\[([\w/]+\.py)\]\(([^)#\s]+)\)", text):
            assert path.endswith(name), (name_of(document), path)


def test_the_flow_of_a_step_names_rooms_and_modules_that_exist():
    flow = README.split("## Where things are")[1].split("```text\n")[1].split("```")[0]
    for line in flow.splitlines():
        _, rooms, modules = re.split(r"  +", line.strip().removeprefix("→ "))
        house, *names = re.split(r"[/,] *", rooms)
        folders = [ROOT / house / name for name in names] or [ROOT / house]
        for module in modules.split(", "):
            assert any((f / f"{module}.py").exists() for f in folders), line


def test_pictures_in_documents_are_small():
    pictures = list((ROOT / "docs" / "images").iterdir())
    assert pictures
    for picture in pictures:
        limit = 600_000 if picture.suffix == ".gif" else 200_000
        assert picture.stat().st_size < limit, picture.name


def test_ci_types_the_lines_of_the_readme_before_all_else():
    ci = (ROOT / ".ci" / "run").read_text()
    function = re.search(r"^readme_line\(\) .*?^}$", ci, re.M | re.S)[0]
    for section in ("Set-up", "Test"):
        (line,) = commands(README.split(f"\n## {section}\n")[1].split("\n## ")[0])
        read = f"{function}\nreadme_line {section}"
        typed = subprocess.run(["bash", "-c", read], cwd=ROOT, stdout=-1, check=True)
        assert typed.stdout.decode().splitlines() == [line]
    step = r'step "the README\'s \w+ line: [^"]+"\n'
    first, second = (
        re.escape(f'eval "$(readme_line {s})" || exit 1\n') for s in ("Set-up", "Test")
    )
    check = r"\[\[ .* \]\]\n"
    both = re.search(rf"{step}{first}{check}\n{step}{second}", ci)
    before = ci[: both.start()]
    assert not re.search(r"\bpip3? |\buv |apt-get|export", before)
    assert re.search(r"^unset .*\bPIP_CONSTRAINT\b", before, re.M)


TESTS_OF_A_LIBRARY = """
import os
import pytest

def test_always(): pass

@pytest.mark.skipif("LIBRARY" not in os.environ, reason="needs a library")
def test_with_the_library(): pass

def test_that_fails(): assert "MENDED" in os.environ
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["0", "2"])
def test_the_remaining_tests_are_those_that_have_not_passed(workers, tmp_path):
    def passed(*options, **environment):
        command = [sys.executable, "-m", "pytest", "-v", "-n", workers, *options]
        options = {"cwd": tmp_path, "env": {**os.environ, **environment}}
        done = subprocess.run(command, **options, stdout=-1, check=False)
        tests = r"PASSED.* test_it.py::(\w+)|test_it.py::(\w+) PASSED"
        return {"".join(names) for names in re.findall(tests, done.stdout.decode())}

    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "test_it.py").write_text(TESTS_OF_A_LIBRARY)
    assert passed() == {"test_always"}
    assert passed("--remaining", LIBRARY="1") == {"test_with_the_library"}
    if workers == "0":
        assert passed("--remaining") == set()
        both = {"test_with_the_library", "test_that_fails"}
        assert passed("--remaining", LIBRARY="1", MENDED="1") == both
        assert passed(LIBRARY="1", MENDED="1") == {"test_always", *both}
        assert passed("--remaining") == set()


def test_contributing_lists_the_checks_of_ci():
    ci = (ROOT / ".ci" / "run").read_text().splitlines()
    checks = next(blocks((ROOT / "CONTRIBUTING.md").read_text(), "bash"))[0]
    named = {"ruff check", "ruff format --check", "codespell", "mypy"}
    shown = [line for line in ci if line in named]
    assert checks.splitlines() == [*shown, "pytest -n auto"]


def test_functions_and_classes_that_contributing_names_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = set(re.findall(r"`([A-Za-z]\w*(?:_\w+|[a-z][A-Z]\w+))`", text))
    assert {"EkfSlam", "check_estimator", "AssociationPolicy"} <= named
    folders = ["src/slamgym", *PACKAGES]
    files = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
    known = set(re.findall(r"\w+", "\n".join(file.read_text() for file in files)))
    assert named <= known


def test_the_paper_cites_all_its_references_and_no_other():
    text, listed = (
        (ROOT / "paper" / f"paper.{end}").read_text() for end in ("md", "bib")
    )
    cited = re.findall(r"@([a-z]+\d*)\b", text.partition("---\n\n")[2])
    assert set(cited) == set(re.findall(r"^@\w+\{(\w+),", listed, re.MULTILINE))
    assert 250 <= len(text.split()) <= 1000


def test_version_licence_and_python_agree_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {slamgym.__version__}\n" in citation
    assert f"license: {project['license']}\n" in citation
    assert (ROOT / "LICENSE").read_text().startswith(f"{project['license']} License")
    assert slamgym.__version__ in (ROOT / "CHANGELOG.md").read_text()
    pythons = re.findall(r"Python :: (3\.\d+)", " ".join(project["classifiers"]))
    assert pythons == [f"3.{minor}" for minor in range(11, 11 + len(pythons))]
    oldest = project["requires-python"].removeprefix(">=")
    assert f"Python {oldest} or newer" in README


def test_hooks_use_what_is_installed():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text()
    assert set(re.findall(r"repo: (\S+)", hooks)) == {"local"}
    assert set(re.findall(r"language: (\S+)", hooks)) == {"system"}


def test_references_in_docstrings_lead_to_names_that_exist():
    places = dict.fromkeys(PACKAGES, "")  # text by the name of a module or a class
    for folder in ("src/slamgym", *PACKAGES):
        for file in (ROOT / folder).rglob("*.py"):
            text = file.read_text()
            for place in (file.stem, *re.findall(r"^class (\w+)", text, re.M)):
                places[place] = places.get(place, "") + text
    named = re.compile(r":(?:func|class|meth|data|attr):`~?\.?(?:\w+\.)*?(\w+)\.(\w+)`")
    for place, name in named.findall("".join(places.values())):
        if place not in ("slamgym", "linalg", *PACKAGES):  # another library
            found = rf"(?m)^\s*(?:def|class) {name}\b|^\s*{name}\b(?:: | = )"
            assert re.search(found, places.get(place, "")), f"{place}.{name}"
