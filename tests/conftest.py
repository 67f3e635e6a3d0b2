import os
from pathlib import Path

import pytest

# Before numpy is loaded: BLAS threads that wait for a core which others use make small
# products fifty times slower.  Subprocesses inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Subprocesses of tests import the modules in tests/support, too.
_SUPPORT = str(Path(__file__).parent / "support")
os.environ["PYTHONPATH"] = os.pathsep.join(
    [_SUPPORT, *filter(None, [os.environ.get("PYTHONPATH")])]
)


@pytest.fixture
def public_logs():
    """Return the folder of public logs, which are not part of the repository."""
    folder = os.environ.get("SLAMGYM_DATA", "")
    if not folder or not Path(folder).is_dir():
        pytest.skip("SLAMGYM_DATA names no folder of public logs")
    return Path(folder)
