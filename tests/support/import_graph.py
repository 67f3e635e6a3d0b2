"""The imports between the modules of the repository, read from their source."""

import ast
from functools import cache
from pathlib import Path

from slamgym.public_names import listed

ROOT = Path(__file__).parents[2]
PACKAGES = ("sim_configs", "envs", "estimator", "evaluation", "agents", "experiments")
# Beside the rooms; every room may import them.
GROUND = {
    *("argument_checks", "arrays", "jit", "kernel_variants", "leaves"),
    *("public_names", "restorable", "suggestions"),
}


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
def public_targets():
    """Return where each public name of each package is: package → name → module."""
    return {
        module: {
            name: f"{module}.{part}".removesuffix(".")
            for name, part in listed(file).items()
        }
        for module, file in FILES.items()
        if file.name == "__init__.py"
    }


def defining_module(module, name):
    """Return the module that ``from module import name`` takes the name from."""
    public = public_targets()
    while public.get(module, {}).get(name, module) != module:
        module = public[module][name]
    inside = f"{module}.{name}"
    return inside if inside in FILES else module


@cache
def import_statements(module):
    """Return the import statements of a module, also those in functions.

    The public names of a package, below ``if TYPE_CHECKING:``, are loaded on demand.
    """
    tree = ast.parse(FILES[module].read_text())
    if FILES[module].name == "__init__.py":
        tree.body = [node for node in tree.body if not isinstance(node, ast.If)]
    nodes = ast.walk(tree)
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


def code_lines(module):
    """Return how many lines are neither blank nor comment nor docstring."""
    text = FILES[module].read_text()
    docstrings = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        for line in range(node.lineno, node.end_lineno + 1)
    }
    lines = enumerate(map(str.strip, text.splitlines()), 1)
    return sum(bool(x) and x[0] != "#" and n not in docstrings for n, x in lines)


@cache
def graph():
    """Return the modules that each module imports."""
    return {module: imports_of(module) for module in FILES}
