"""The public names of each package, loaded at their first use; and modules that moved.

A package lists its public names once, as imports below ``if TYPE_CHECKING:`` in its
``__init__.py``: type checkers read them there, and :func:`attach` at run time.
"""

import ast
import sys
import warnings
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from pathlib import Path
from types import ModuleType
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


def listed(file: Path) -> dict[str, str]:
    """Return each public name of a package, and the module below it that has the name.

    The module is empty for names that are modules themselves.  ``from .part import *``
    stands for the names, other than modules, that the subpackage ``part`` lists.

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
                if alias.name == "*":
                    inner = listed(file.parent / module / "__init__.py")
                    names |= {name: module for name, its in inner.items() if its}
                else:
                    names[alias.name] = module
    return names


#: Modules that no longer exist, and where their names are now.
MOVED = {
    "envs.sensors": "envs",
    "estimator.belief": "estimator.interface",
    "estimator.error_frames": "estimator.models.rigid_motion",
    "estimator.filters.first_estimates": "estimator.filters",
    "estimator.filters.invariant": "estimator.filters",
    "estimator.filters.iterated": "estimator.filters",
    "estimator.filters.observability_constrained": "estimator.filters",
    "estimator.models.unicycle_motion": "estimator.models.motions",
    "estimator.update_report": "estimator.interface",
    "evaluation.chi_square": "evaluation.hypothesis_tests",
    "evaluation.error_findings": "evaluation.diagnosis",
    "evaluation.time_average_tests": "evaluation.hypothesis_tests",
    "evaluation.whiteness": "evaluation.hypothesis_tests",
    "sim_configs.drawn_scenarios": "sim_configs.scenario_files",
    "sim_configs.layouts": "sim_configs.landmarks_and_controls",
    "sim_configs.randomisation": "sim_configs.scenario",
    "sim_configs.scenario_errors": "sim_configs.field_types",
    "sim_configs.scenario_parts": "sim_configs.scenario",
}


class _MovedModules(MetaPathFinder, Loader):
    """Import a module of `MOVED` as the new place of its names, with a warning."""

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        moved = name.removeprefix(f"{__package__}.") in MOVED
        return spec_from_loader(name, self) if moved else None

    def exec_module(self, module: ModuleType) -> None:
        old = module.__name__
        new = f"{__package__}.{MOVED[old.removeprefix(f'{__package__}.')]}"
        message = f"{old} no longer exists; import its names from {new}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)

        def from_new_place(name: str) -> Any:
            if name.startswith("__"):  # attributes of the module itself
                raise AttributeError(f"module {old!r} has no attribute {name!r}")
            return getattr(import_module(new), name)

        vars(module)["__getattr__"] = from_new_place


sys.meta_path.append(_MovedModules())
