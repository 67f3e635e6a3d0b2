"""``slamgym run``: drive through a scenario, filter what the robot reads, draw."""

import shlex
from functools import partial

from ...sim_configs import save_scenario
from .commands import command
from .options import Options, ScenarioName, compared_filters, takes, with_options


@command
@takes(
    "labels option_texts seed steps controller set_ out every_step rerun resolution "
    "as_json"
)
def run(scenario: ScenarioName, *, given: Options) -> None:
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
    from ..run_and_replay.filter_settings import settings_for_scenario
    from .output_folder import SCENARIO, default_folder, output_folder
    from .run_files import check_rerun, filter_and_write, show_run

    world = given.scenario(scenario)
    filters = given.filters(partial(settings_for_scenario, world))
    reporter = given.reporter()
    check_rerun(given.rerun)
    place = given.out or default_folder(world.name, *filters)
    with output_folder(place) as folder:
        with reporter.progress("driving") as tick:
            log = given.record(world, tick)
        save_scenario(world, folder / SCENARIO)
        summary = filter_and_write(log, filters, folder, given, reporter, world=world)
    show_run(summary, place, given, reporter)
    changed = [f"--set={change}" for change in given.set_ or ()]
    if given.steps is not None:
        changed.append(f"--steps={given.steps}")
    texts = given.option_texts or ()
    tested = compared_filters([with_options(label, texts) for label in filters])
    test = ["slamgym", "monte-carlo", scenario, *changed, "-e", ",".join(tested)]
    reporter.show_verbatim(
        "\nOne run is no test of a filter: its errors depend on the noise. Test with\n"
        f"{shlex.join(test)}"
    )
