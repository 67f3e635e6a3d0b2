from .report import write_html_report as write_html_report
from .results import load_results as load_results
from .results import merge_blocks as merge_blocks
from .runner import monte_carlo as monte_carlo
from .summary import consistency_of as consistency_of
from .summary import summarise_monte_carlo as summarise_monte_carlo
