from .report.html_report import write_html_report as write_html_report
from .report.summary import consistency_of as consistency_of
from .report.summary import summarise_monte_carlo as summarise_monte_carlo
from .runner import monte_carlo as monte_carlo
from .store.result_blocks import merge_blocks as merge_blocks
from .store.results import load_results as load_results
