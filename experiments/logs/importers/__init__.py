"""Readers of public log formats, one module each.

``any_format`` recognises a format by the first line of a file, or by the
files in a folder.
"""

from typing import TYPE_CHECKING

from ....public_names import attach

if TYPE_CHECKING:
    from .any_format import read_log as read_log
else:
    __getattr__, __dir__, __all__ = attach(__name__)
