from .run_frames import RunFrames as RunFrames
from .run_page import ViewedRun as ViewedRun
from .run_page import write_run_page as write_run_page
