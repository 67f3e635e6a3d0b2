"""What people do with worlds and estimators.

* :mod:`~slamgym.experiments.logs` reads, writes and records logs of readings.
* :mod:`~slamgym.experiments.run_and_replay` filters a log or simulated runs, and
  summarises them.
* :mod:`~slamgym.experiments.figures` draws a run: map, errors, covariance.
* :mod:`~slamgym.experiments.monte_carlo_study` tests the consistency of filters in many
  runs.
* :mod:`~slamgym.experiments.judging` judges the estimates of other programs, and
  :mod:`~slamgym.experiments.space_poses` those of poses in space.
* :mod:`~slamgym.experiments.noise_study` scales each noise, in one run or in many.
* :mod:`~slamgym.experiments.noise_fitting` fits the noise of logs.
* :mod:`~slamgym.experiments.trajectories` generates data sets of trajectories.
* :mod:`~slamgym.experiments.viewers` writes a run as a web page, or for rerun.

The command line ``slamgym`` is ``command_line``.
"""

from typing import TYPE_CHECKING

from ..public_names import attach

if TYPE_CHECKING:
    from . import figures as figures
    from . import logs as logs
    from . import monte_carlo_study as monte_carlo_study
    from . import noise_fitting as noise_fitting
    from . import noise_study as noise_study
    from . import run_and_replay as run_and_replay
    from . import trajectories as trajectories
    from . import viewers as viewers
    from .figures import *
    from .judging import judge as judge
    from .logs import *
    from .monte_carlo_study import consistency_of as consistency_of
    from .monte_carlo_study import heading_figure as heading_figure
    from .monte_carlo_study import load_results as load_results
    from .monte_carlo_study import merge_blocks as merge_blocks
    from .monte_carlo_study import monte_carlo as monte_carlo
    from .monte_carlo_study import nees_figure as nees_figure
    from .monte_carlo_study import nis_figure as nis_figure
    from .monte_carlo_study import rmse_figure as rmse_figure
    from .monte_carlo_study import runs_figure as runs_figure
    from .monte_carlo_study import summarise_monte_carlo as summarise_monte_carlo
    from .monte_carlo_study import verdict_table as verdict_table
    from .monte_carlo_study import write_html_report as write_html_report
    from .noise_fitting import *
    from .noise_study import NoiseEffect as NoiseEffect
    from .noise_study import NoiseRow as NoiseRow
    from .noise_study import NoiseRun as NoiseRun
    from .noise_study import noise_effects as noise_effects
    from .noise_study import noise_effects_figure as noise_effects_figure
    from .noise_study import scaled_scenario as scaled_scenario
    from .noise_study import study_log as study_log
    from .noise_study import study_scenario as study_scenario
    from .run_and_replay import *
    from .space_poses import judge_in_space as judge_in_space
    from .trajectories import *
    from .viewers import *
else:
    __getattr__, __dir__, __all__ = attach(__name__)
