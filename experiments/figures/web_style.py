"""The common style of all web pages: their colours, and how templates are filled."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

_SHARED = Path(__file__).parent


def page_environment(
    folder: Path, finalize: Callable[[Any], Any] | None = None
) -> Environment:
    """Return an environment that escapes every value and refuses unknown ones.

    Its templates may include ``web_style.css``, the colours and fonts in light and
    dark.

    Parameters
    ----------
    folder : Path
        Where the templates are.
    finalize : callable, optional
        Applied to every value before it is written.
    """
    return Environment(
        loader=FileSystemLoader([folder, _SHARED]),
        autoescape=True,
        finalize=finalize,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )


def page_template(folder: Path, name: str) -> Template:
    """Return a template of a folder; see :func:`page_environment`."""
    return page_environment(folder).get_template(name)
