"""The layers of the repository, enforced: who may import whom."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LAYERS = ("estimator", "sim_configs", "envs", "agents", "experiments")
MAY_IMPORT = {
    "estimator": {"numpy", "scipy", "numba", "psutil", "estimator"},
    "sim_configs": {"numpy", "pydantic", "pydantic_core", "sim_configs"},
    "envs": {"numpy", "gymnasium", "pymunk", "sim_configs", "envs"},
    "agents": {"numpy", "gymnasium", "sim_configs", "envs", "estimator", "agents"},
}
DRAWING = {  # the only files that may import matplotlib and what it writes with
    "envs": {
        "renderer",
        "artists",
        "scene",
        "blitting",
        "window",
        "video",
    },
    "estimator": {"plotting"},
    "sim_configs": set(),
    "agents": set(),
}
FILES = [file for layer in MAY_IMPORT for file in sorted((ROOT / layer).rglob("*.py"))]


def imported_packages(file):
    """Top-level packages a file imports; relative ones by the layer they reach."""
    inside = file.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level == 0:
                yield node.module.split(".")[0]
            elif node.level <= len(inside):
                yield inside[0]
            else:
                names = [node.module] if node.module else [a.name for a in node.names]
                yield from (name.split(".")[0] for name in names)


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_a_file_imports_only_what_its_layer_may(file):
    layer = file.relative_to(ROOT).parts[0]
    allowed = MAY_IMPORT[layer] | set(sys.stdlib_module_names) | {"lazy_loader"}
    if file.stem in DRAWING[layer]:
        allowed = allowed | {"matplotlib", "PIL", "imageio_ffmpeg"}
    assert set(imported_packages(file)) <= allowed


def test_modules_are_imported_relatively_inside_the_package():
    for file in (f for layer in LAYERS for f in (ROOT / layer).rglob("*.py")):
        imports = [
            line
            for line in file.read_text().splitlines()
            if line.startswith(("import ", "from ")) and " slamgym" in f" {line}"
        ]
        assert not [line for line in imports if line.split()[1].startswith("slamgym")]
