"""The public names: lazy, listed, importable, and readable in pydoc."""

import ast
import importlib
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest

import slamgym

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "slamgym"
FOLDERS = ("agents", "envs", "estimator", "evaluation", "experiments", "sim_configs")
STUBS = [PACKAGE / "__init__.pyi"] + [
    PACKAGE / stub.relative_to(ROOT)
    for folder in FOLDERS
    for stub in sorted((ROOT / folder).rglob("__init__.pyi"))
]
PROMISED = {
    *("EkfSlam", "InvariantEkfSlam", "LandmarkWorldEnv"),
    *("make_estimator", "list_estimators", "check_estimator", "assert_consistent"),
    *("load_scenario", "monte_carlo", "replay", "read_log", "generate_trajectories"),
}
MARKDOWN = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
ANNOTATIONS_UNFOLDED = {  # need ``from __future__ import annotations``
    "slamgym",
    "slamgym.estimator",
    "slamgym.estimator.filters",
}
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)
DOCUMENTED = {
    **{str(f.relative_to(ROOT)): BLOCK.findall(f.read_text()) for f in MARKDOWN},
    **{f"examples/{f.name}": [f.read_text()] for f in ROOT.glob("examples/*.py")},
}


def package_of(stub):
    return ".".join(stub.parent.relative_to(PACKAGE.parent).parts)


def stub_names(stub):
    """Return the names that a stub imports."""
    tree = ast.parse(stub.read_text())
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    return sorted(alias.name for node in imports for alias in node.names)


def documented_imports(code):
    """Yield (module, names) of the imports from slamgym in a piece of code."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("slamgym"):
            yield node.module, [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from ((a.name, []) for a in node.names if "slamgym" in a.name)


def pydoc_of(name):
    return subprocess.run(
        [sys.executable, "-m", "pydoc", name],
        check=True,
        capture_output=True,
        text=True,
        encoding="utf-8",
    ).stdout


def test_the_main_names_are_at_the_top():
    assert PROMISED | set(FOLDERS) <= set(dir(slamgym))
    assert all(hasattr(slamgym, name) for name in PROMISED)


@pytest.mark.parametrize("stub", STUBS, ids=package_of)
def test_a_package_lists_its_public_names_and_each_can_be_imported(stub):
    package = importlib.import_module(package_of(stub))
    assert sorted(package.__all__) == stub_names(stub)
    assert set(package.__all__) <= set(dir(package))
    assert all(hasattr(package, name) for name in package.__all__)


@pytest.mark.slow
def test_a_public_name_is_the_object_and_not_the_module_of_the_same_name():
    code = (
        "import slamgym.estimator.check_estimator, slamgym.experiments.runs\n"
        "from slamgym import check_estimator, replay\n"
        "print(check_estimator.__name__, replay.__name__)"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert printed.split() == ["check_estimator", "replay"]


@pytest.mark.parametrize("document", DOCUMENTED)
def test_documented_imports_are_public_and_at_most_two_levels_deep(document):
    for code in DOCUMENTED[document]:
        for module, names in documented_imports(code):
            assert module.count(".") <= 2, module
            public = getattr(importlib.import_module(module), "__all__", None)
            assert public is None or set(names) <= set(public), (module, names)


@pytest.mark.slow
def test_pydoc_lists_the_filters():
    classes = pydoc_of("slamgym.estimator").split("\nCLASSES\n")[1]
    for name in slamgym.estimator.__all__:
        if isinstance(getattr(slamgym.estimator, name), type):
            assert re.search(rf"^ +[\w.]*\.{name}\b", classes, re.M), name


@pytest.mark.slow
@pytest.mark.parametrize(
    "package", sorted({package_of(stub) for stub in STUBS} - ANNOTATIONS_UNFOLDED)
)
def test_help_shows_annotations_as_written(package):
    module = importlib.import_module(package)
    text = "".join(
        pydoc.render_doc(value, renderer=pydoc.plaintext)
        for name in module.__all__
        if callable(value := getattr(module, name))
    )
    assert not {"_NestedSequence", "_SupportsArray"} & set(re.findall(r"\w+", text))
