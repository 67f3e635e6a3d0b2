"""The public names of each package, loaded at their first use.

A package lists its public names once, as imports below ``if TYPE_CHECKING:`` in its
``__init__.py``: type checkers read them there, and :func:`attach` at run time.
"""

import ast
import sys
from functools import cache
from pathlib import Path
from typing import Any

import lazy_loader


def attach(package: str) -> Any:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Parameters
    ----------
    package : str
        The ``__name__`` of the package that is being imported.
    """
    names: dict[str, list[str]] = {}
    for name, module in listed(Path(str(sys.modules[package].__file__))).items():
        names.setdefault(module, []).append(name)
    return lazy_loader.attach(package, names.pop("", ()), names)


@cache
def listed(file: Path) -> dict[str, str]:
    """Return each public name of a package, and the module below it that has the name.

    The module is empty for names that are modules themselves.  ``from .part import *``
    stands for the names, other than modules, that the subpackage ``part`` lists.  Names
    of a leaf that has been deleted are left out.

    Parameters
    ----------
    file : Path
        The package's ``__init__.py``.
    """
    tree = ast.parse(file.read_text(encoding="utf-8"))
    blocks = [node.body for node in tree.body if isinstance(node, ast.If)]
    names: dict[str, str] = {}
    for node in [node for block in blocks for node in block]:
        if isinstance(node, ast.ImportFrom):
            module = node.module or ""
            for alias in node.names:
                if not holds(file.parent, module or alias.name):
                    continue
                if alias.name == "*":
                    inner = listed(file.parent / module / "__init__.py")
                    names |= {name: module for name, its in inner.items() if its}
                else:
                    names[alias.name] = module
    return names


def is_here(module: str) -> bool:
    """Return whether a module or folder of the package exists, by its dotted name."""
    return holds(Path(__file__).parent, module)


def holds(folder: Path, module: str) -> bool:
    """Return whether a folder holds a module or room, by its dotted name in it."""
    place = folder.joinpath(*module.split("."))
    return (place / "__init__.py").is_file() or place.with_suffix(".py").is_file()
