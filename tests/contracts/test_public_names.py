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
FOLDERS = ("agents", "envs", "estimator", "evaluation", "experiments", "sim_configs")
PACKAGES = ["slamgym"] + [
    ".".join(["slamgym", *init.parent.relative_to(ROOT).parts])
    for folder in FOLDERS
    for init in sorted((ROOT / folder).rglob("__init__.py"))
    if "attach(__name__)" in init.read_text()
]
MODULES = [
    ".".join(["slamgym", *file.relative_to(ROOT).with_suffix("").parts])
    for folder in FOLDERS
    for file in sorted((ROOT / folder).rglob("*.py"))
    if file.stem != "__init__" and "\n__all__ = [" in file.read_text()
]
PROMISED = {
    *("EkfSlam", "InvariantEkfSlam", "LandmarkWorldEnv", "Waypoints", "Scenario"),
    *("Belief", "UpdateReport", "LandmarkPolicy", "smooth", "fit_noise"),
    *("consistency_of", "load_trajectories", "register_estimator"),
    *("make_estimator", "list_estimators", "check_estimator", "assert_consistent"),
    *("load_scenario", "monte_carlo", "replay", "read_log", "generate_trajectories"),
    "judge",
}
MARKDOWN = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
SCRIPTS = [*ROOT.glob("examples/*.py"), *ROOT.glob("docs/tutorials/*.py")]
ANNOTATIONS_UNFOLDED = {  # need ``from __future__ import annotations``
    "slamgym",
    "slamgym.estimator",
    "slamgym.estimator.filters",
}
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)
DOCUMENTED = {
    **{str(f.relative_to(ROOT)): BLOCK.findall(f.read_text()) for f in MARKDOWN},
    **{str(f.relative_to(ROOT)): [f.read_text()] for f in SCRIPTS},
}


def documented_imports(code):
    """Yield (module, names) of the imports from slamgym in a piece of code."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("slamgym"):
            yield node.module, [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from ((a.name, []) for a in node.names if "slamgym" in a.name)


def test_the_main_names_are_at_the_top():
    assert PROMISED | set(FOLDERS) <= set(dir(slamgym))
    assert all(hasattr(slamgym, name) for name in PROMISED)


@pytest.mark.parametrize("name", MODULES)
def test_a_module_with_public_names_lists_no_others(name):
    module = importlib.import_module(name)
    assert dir(module) == sorted(module.__all__)


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_lists_its_public_names_and_each_can_be_imported(name):
    package = importlib.import_module(name)
    assert package.__all__
    assert set(package.__all__) <= set(dir(package))
    assert all(hasattr(package, name) for name in package.__all__)


@pytest.mark.parametrize("name", [name for name in PACKAGES if name.count(".") > 1])
def test_public_names_need_no_import_deeper_than_two_levels(name):
    short = importlib.import_module(".".join(name.split(".")[:2]))
    module = importlib.import_module(name)
    for public in module.__all__:
        assert getattr(short, public, None) is getattr(module, public), public


@pytest.mark.slow
def test_a_public_name_is_the_object_and_not_the_module_of_the_same_name():
    code = (
        "import slamgym.estimator.check_estimator, slamgym.experiments.run_and_replay\n"
        "from slamgym import check_estimator, replay\n"
        "print(check_estimator.__name__, replay.__name__)"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert printed.split() == ["check_estimator", "replay"]


@pytest.mark.parametrize("document", DOCUMENTED)
def test_documented_imports_are_public_and_at_most_two_levels_deep(document):
    for code in DOCUMENTED[document]:
        for module, names in documented_imports(code):
            assert module.count(".") <= 1, module
            public = getattr(importlib.import_module(module), "__all__", None)
            assert public is None or set(names) <= set(public), (module, names)


def test_pydoc_lists_the_filters():
    page = pydoc.render_doc(slamgym.estimator, renderer=pydoc.plaintext)
    classes = page.split("\nCLASSES\n")[1]
    for name in slamgym.estimator.__all__:
        if isinstance(getattr(slamgym.estimator, name), type):
            assert re.search(rf"^ +[\w.]*\.{name}\b", classes, re.M), name


@pytest.mark.slow
@pytest.mark.parametrize("package", sorted(set(PACKAGES) - ANNOTATIONS_UNFOLDED))
def test_help_shows_annotations_as_written(package):
    module = importlib.import_module(package)
    text = "".join(
        pydoc.render_doc(value, renderer=pydoc.plaintext)
        for name in module.__all__
        if callable(value := getattr(module, name))
    )
    assert not {"_NestedSequence", "_SupportsArray"} & set(re.findall(r"\w+", text))
