from .rerun_recording import write_rerun as write_rerun
from .run_frames import RunFrames as RunFrames
from .run_page import write_run_page as write_run_page
from .viewed_run import ViewedRun as ViewedRun
