from .rerun_recording import write_rerun as write_rerun
from .run_page import RunFrames as RunFrames
from .run_page import ViewedRun as ViewedRun
from .run_page import write_run_page as write_run_page
