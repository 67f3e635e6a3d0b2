"""Logs of odometry and measurements: the format, recording, and importers."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .importers import read_log as read_log
    from .recording import record_episode as record_episode
    from .slamlog import LogError as LogError
    from .slamlog import OdometryRow as OdometryRow
    from .slamlog import Scan as Scan
    from .slamlog import SlamLog as SlamLog
    from .slamlog import read_slamlog as read_slamlog
    from .slamlog import write_slamlog as write_slamlog
else:
    __getattr__, __dir__, __all__ = attach(__name__)
