"""Viewers of whole runs, step by step: a web page, and a recording for rerun.

A `RunFrames` watches a replay; the viewers show what it has kept beside the trace.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .rerun_recording import write_rerun as write_rerun
    from .run_page import RunFrames as RunFrames
    from .run_page import ViewedRun as ViewedRun
    from .run_page import write_run_page as write_run_page
else:
    __getattr__, __dir__, __all__ = attach(__name__)
