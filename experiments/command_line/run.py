"""``slamgym run``: drive through a scenario, filter what the robot reads, draw."""

import shlex
from functools import partial

from . import options
from .options import assignments
from .program import command


@command
def run(
    scenario: options.ScenarioName,
    *,
    estimator: options.EstimatorNames = "invariant",
    option: options.EstimatorOptions = None,
    seed: options.Seed = 0,
    steps: options.Steps = None,
    controller: options.ControllerName = "open_loop",
    set_: options.ScenarioChanges = None,
    out: options.OutFolder = None,
    every_step: options.EveryStep = None,
    rerun: options.RerunFile = None,
    resolution: options.Resolution = 0.0,
    as_json: options.AsJson = False,
) -> None:
    """Drive through a scenario, filter, draw.

    Drive a robot through a scenario and estimate its path and the map with filters that
    use the scenario's noise. Writes run.html, a page that plays the run, pictures of
    map, errors and covariance, the log, the scenario and the numbers.

    Examples
    --------
    slamgym run six_landmarks
    slamgym run loop --seed 3 --out loop_3
    slamgym run loop --estimator ekf,invariant
    slamgym run loop -e 'invariant[iterations=3,gate_probability=0.999]'
    slamgym run dense --set sensor.max_range=4 --steps 100 --json
    slamgym run hidden_identities -e invariant --resolution 0.5
    slamgym run mine.toml --controller random --estimator mine:MyFilter
    """
    from ...sim_configs import save_scenario
    from ..runs.filter_settings import settings_for_scenario
    from .options import (
        chosen_filters,
        chosen_scenario,
        recorded,
        tested_filters,
        with_options,
    )
    from .output_folder import default_folder, output_folder
    from .reporter import Reporter
    from .run_files import check_rerun, filter_and_write, show_run

    world = chosen_scenario(scenario, steps, set_)
    filters = chosen_filters(
        estimator,
        assignments("--option", option),
        partial(settings_for_scenario, world),
    )
    reporter = Reporter(as_json=as_json)
    check_rerun(rerun)
    place = out or default_folder(world.name, *filters)
    with output_folder(place) as folder:
        with reporter.progress("driving") as tick:
            log = recorded(world, controller, seed, tick)
        save_scenario(world, folder / "scenario.toml")
        summary = filter_and_write(
            log,
            filters,
            folder,
            every_step,
            reporter,
            resolution=resolution,
            walls=world.walls,
            rerun=rerun,
        )
    show_run(summary, place, reporter)
    changed = [f"--set={change}" for change in set_ or ()]
    if steps is not None:
        changed.append(f"--steps={steps}")
    tested = tested_filters([with_options(label, option or ()) for label in filters])
    test = ["slamgym", "monte-carlo", scenario, *changed, "-e", ",".join(tested)]
    reporter.show_verbatim(
        "\nOne run is no test of a filter: its errors depend on the noise. Test with\n"
        f"{shlex.join(test)}"
    )
