"""Variables of the environment, for libraries and processes begun in a block."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def environment(name: str, value: str) -> Iterator[None]:
    """Set a variable of the environment during the block."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def without_scripts_of_the_user() -> contextlib.AbstractContextManager[None]:
    """Keep the working folder off the import path of processes begun in the block.

    Otherwise, a file random.py in it would replace the module of Python.
    """
    return environment("PYTHONSAFEPATH", "1")
