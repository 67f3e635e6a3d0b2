"""The imports between the modules of the repository, read from their source."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = (
    "sim_configs",
    "envs",
    "estimator",
    "evaluation",
    "agents",
    "experiments",
)
# Beside the rooms; every room may import them.
GROUND = {"arrays", "jit", "kernel_cache", "magnitudes", "suggestions"}


def module_name(file):
    """Return the dotted name below slamgym: ``estimator.filters.ekf``."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(
        ".__init__"
    )


FILES = {
    module_name(file): file
    for package in PACKAGES
    for file in sorted((ROOT / package).rglob("*.py"))
}


def absolute(module, node):
    """Return the name below slamgym that a relative import names, or None."""
    if not node.level:
        return None
    parts = module.split(".")
    if FILES[module].name != "__init__.py":
        parts = parts[:-1]
    inside = parts[: len(parts) - node.level + 1]
    return ".".join([*inside, *filter(None, [node.module])])


@cache
def stub_targets():
    """Return what each lazy name of each package stands for: module → name → module."""
    targets = {}
    for module, file in FILES.items():
        stub = file.with_suffix(".pyi")
        if stub.exists():
            imports = (
                node
                for node in ast.parse(stub.read_text()).body
                if isinstance(node, ast.ImportFrom)
            )
            targets[module] = {
                alias.name: absolute(module, node)
                for node in imports
                for alias in node.names
            }
    return targets


def defining_module(module, name):
    """Return the module that ``from module import name`` takes the name from."""
    stubs = stub_targets()
    if f"{module}.{name}" in FILES and name not in stubs.get(module, {}):
        return f"{module}.{name}"
    while name in stubs.get(module, {}) and stubs[module][name] != module:
        module = stubs[module][name]
    return module


@cache
def import_statements(module):
    """Return the import statements of a module, also those in functions."""
    nodes = ast.walk(ast.parse(FILES[module].read_text()))
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]


def imports_of(module):
    """Return the modules of the repository that a module imports."""
    found = set()
    for node in import_statements(module):
        if isinstance(node, ast.ImportFrom) and node.level:
            target = absolute(module, node)
            found |= {defining_module(target, alias.name) for alias in node.names}
    return found - {module} - GROUND


def libraries(module):
    """Return the packages outside the repository that a module imports."""
    found = set()
    for node in import_statements(module):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif not node.level:
            found.add(node.module.split(".")[0])
    return found


@cache
def graph():
    """Return the modules that each module imports."""
    return {module: imports_of(module) for module in FILES}
