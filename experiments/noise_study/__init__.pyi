from .figures import noise_effects_figure as noise_effects_figure
from .many_runs import NoiseEffect as NoiseEffect
from .many_runs import noise_effects as noise_effects
from .one_run import NoiseRow as NoiseRow
from .one_run import NoiseRun as NoiseRun
from .one_run import study_log as study_log
from .one_run import study_scenario as study_scenario
from .variations import scaled_scenario as scaled_scenario
