"""Argument checks, saved states, memory limits and undo, shared by all estimators."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from . import argument_checks as argument_checks
else:
    __getattr__, __dir__, __all__ = attach(__name__)
