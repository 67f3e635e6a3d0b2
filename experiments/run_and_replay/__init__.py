"""Run filters over a log or over simulated worlds, and summarise the runs."""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .filter_settings import FilterSettings as FilterSettings
    from .filter_settings import settings_for as settings_for
    from .filter_settings import settings_for_scenario as settings_for_scenario
    from .log_replay import Replay as Replay
    from .log_replay import replay as replay
    from .log_smoothing import SmoothedLog as SmoothedLog
    from .log_smoothing import smooth as smooth
    from .log_smoothing import smooth_log as smooth_log
    from .log_smoothing import summarise_smoothing as summarise_smoothing
    from .simulated_runs import SimulatedRuns as SimulatedRuns
    from .simulated_runs import simulate_runs as simulate_runs
    from .summary import landmark_table as landmark_table
    from .summary import summarise as summarise
    from .trace import RunTrace as RunTrace
else:
    __getattr__, __dir__, __all__ = attach(__name__)
