from . import figures as figures
from . import logs as logs
from . import monte_carlo as monte_carlo
from . import noise_fitting as noise_fitting
from . import noise_study as noise_study
from . import runs as runs
from . import trajectories as trajectories
from . import viewers as viewers
