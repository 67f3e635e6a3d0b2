"""Checks of arguments and saved states, and marks of interrupted calls."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from . import argument_checks as argument_checks
else:
    __getattr__, __dir__, __all__ = attach(__name__)
