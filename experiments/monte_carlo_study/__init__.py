"""Run filters many times over a scenario, and test their consistency.

``runner`` does the whole job: simulated runs → ``filtered_runs`` → ``run_measures``
→ ``results``.  ``verdict`` and ``summary`` judge the results, and ``figures`` and
``report`` show them.
"""

from typing import TYPE_CHECKING

from ...public_names import attach

if TYPE_CHECKING:
    from .figures import heading_figure as heading_figure
    from .figures import nees_figure as nees_figure
    from .figures import nis_figure as nis_figure
    from .figures import rmse_figure as rmse_figure
    from .figures import runs_figure as runs_figure
    from .report import write_html_report as write_html_report
    from .results import load_results as load_results
    from .results import merge_blocks as merge_blocks
    from .runner import monte_carlo as monte_carlo
    from .summary import consistency_of as consistency_of
    from .summary import summarise_monte_carlo as summarise_monte_carlo
    from .summary import verdict_table as verdict_table
else:
    __getattr__, __dir__, __all__ = attach(__name__)
