"""The command line ``slamgym``.

What a command does lies in a module of its own and is loaded when it runs, so that
help answers at once.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from ... import __version__
from . import option_types as options
from .errors import BadInputError, OneLineErrors
from .option_values import assignments, changes, standard_deviations

main = typer.Typer(
    name="slamgym",
    cls=OneLineErrors,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def _taught(text: str, *examples: str) -> str:
    r"""Compose a help text; after \b its lines are left as they are."""
    lines = "\n".join(f"  {example}" for example in examples)
    return f"{text}\n\n\b\nExamples:\n{lines}"


def _given(**values: Any) -> dict[str, Any]:
    """Keep the options that the user gave."""
    return {name: value for name, value in values.items() if value is not None}


def _stds(
    motion_std: str | None, measurement_std: str | None, initial_pose_std: str | None
) -> dict[str, tuple[float, ...]]:
    """Read the standard deviations that the user gave."""
    texts = {
        "motion_std": (motion_std, 3),
        "measurement_std": (measurement_std, 2),
        "initial_pose_std": (initial_pose_std, 3),
    }
    return {
        name: standard_deviations(f"--{name.replace('_', '-')}", text, count)
        for name, (text, count) in texts.items()
        if text is not None
    }


def _refuse(given: Mapping[str, object], meant_for: str) -> None:
    """Refuse options that have no meaning here."""
    for name in given:
        option = f"--{name.replace('_', '-')}"
        raise BadInputError(f"{option} is for the noise study of {meant_for}")


@main.callback(
    invoke_without_command=True,
    help=_taught(
        "Landmark worlds to drive a robot in, and EKF-SLAM filters to follow it.",
        "slamgym scenarios                 what worlds there are",
        "slamgym run six_landmarks         drive in one, filter, draw",
        "slamgym replay data.txt           filter a log, draw",
        "slamgym COMMAND --help            what else a command can do",
    ),
)
def _slamgym(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.")
    ] = False,
) -> None:
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)  # for estimators of one's own, "module:Class"
    if version:
        typer.echo(f"slamgym {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


@main.command(
    short_help="Drive through a scenario, filter, draw.",
    help=_taught(
        "Drive a robot through a scenario and follow it with a filter, which knows the "
        "scenario's noise. Writes pictures of map, errors and covariance, the log, the "
        "scenario and the numbers.",
        "slamgym run six_landmarks",
        "slamgym run loop --seed 3 --out loop_3",
        "slamgym run dense --set sensor.max_range=4 --steps 100 --json",
        "slamgym run mine.toml --controller random --estimator mine:MyFilter",
    ),
)
def run(
    scenario: options.ScenarioName,
    *,
    estimator: options.EstimatorName = "ekf",
    option: options.EstimatorOptions = None,
    seed: options.Seed = 0,
    steps: options.Steps = None,
    controller: options.ControllerName = "open_loop",
    set_: options.ScenarioChanges = None,
    out: options.OutFolder = None,
    every_step: options.EveryStep = None,
    as_json: options.AsJson = False,
) -> None:
    """Drive, filter, and write all down."""
    from ..runs.filter_settings import settings_for_scenario  # noqa: PLC0415 (heavy)
    from . import run_and_replay, scenario_options  # noqa: PLC0415 (heavy)

    world = scenario_options.chosen_scenario(scenario, steps=steps, sets=set_ or [])
    chosen = assignments("--option", option or [])
    run_and_replay.run_scenario(
        world,
        settings_for_scenario(world, estimator=estimator, options=chosen),
        controller=controller,
        seed=seed,
        output=run_and_replay.Output(out, every_step, as_json),
    )


@main.command(
    short_help="Filter a log, compare with the truth, draw.",
    help=_taught(
        "Filter a log, and compare with the truth as far as it is known: prints every "
        "landmark with its Euclidean and Mahalanobis distance to its true place.",
        "slamgym replay data.txt",
        "slamgym replay data.txt --landmark-init independent --out homework",
        "slamgym replay sensor.dat --motion-std .1,.1,.01 --measurement-std .1,.1",
        "slamgym replay results/loop-ekf/log.csv --estimator invariant",
    ),
)
def replay(
    log: options.LogPath,
    *,
    estimator: options.EstimatorName = "ekf",
    motion_std: options.MotionStd = None,
    measurement_std: options.MeasurementStd = None,
    initial_pose_std: options.InitialPoseStd = None,
    landmark_init: options.LandmarkInit = None,
    gate_probability: options.GateProbability = None,
    range_std_per_metre: options.RangeStdPerMetre = None,
    noise_at_rest: options.NoiseAtRest = None,
    option: options.EstimatorOptions = None,
    robot: options.Robot = None,
    out: options.OutFolder = None,
    every_step: options.EveryStep = None,
    as_json: options.AsJson = False,
) -> None:
    """Filter a log, and write all down."""
    from ..runs.filter_settings import settings_for  # noqa: PLC0415 (heavy)
    from . import run_and_replay  # noqa: PLC0415 (heavy)

    chosen = _given(
        landmark_init=landmark_init,
        gate_probability=gate_probability,
        range_std_per_metre=range_std_per_metre,
        noise_at_rest=noise_at_rest,
    )
    drive = run_and_replay.read_any_log(log, robot)
    settings = settings_for(
        drive,
        estimator=estimator,
        **_stds(motion_std, measurement_std, initial_pose_std),
        options={**chosen, **assignments("--option", option or [])},
    )
    output = run_and_replay.Output(out, every_step, as_json)
    run_and_replay.replay_log(drive, settings, output)


@main.command(
    name="monte-carlo",
    short_help="Many runs: do the filters tell the truth?",
    help=_taught(
        "Run filters many times over a scenario, all on the same random numbers, and "
        "decide with known error rates whether their covariances tell the truth about "
        "their errors. Writes results.nc (estimator x run x step, for xarray), "
        "summary.json and a report to open in a browser, report.html.",
        "slamgym monte-carlo loop --estimators ekf,invariant --runs 200 --out loop",
        "slamgym monte-carlo six_landmarks -e mine:MyFilter --runs 100 --jobs 4",
        "slamgym monte-carlo loop --assume motion.std=[0.1,0.1,0.1]",
        "slamgym monte-carlo loop --runs 5000 --backend dask --scheduler tcp://boss:8786",
    ),
)
def monte_carlo(
    scenario: options.ScenarioName,
    *,
    estimators: options.EstimatorNames = "ekf,invariant",
    runs: options.Runs = 200,
    seed: options.Seed = 0,
    steps: options.Steps = None,
    set_: options.ScenarioChanges = None,
    assume: options.AssumedChanges = None,
    jobs: options.Jobs = None,
    backend: options.Backend = None,
    scheduler: options.Scheduler = None,
    block_size: options.RunsPerBlock = 64,
    first_run: options.FirstRun = 0,
    merge: options.MergedFolders = None,
    fresh: options.Fresh = False,
    out: options.ResumableFolder = None,
    as_json: options.AsJson = False,
) -> int:
    """Run many times, measure and decide."""
    from . import monte_carlo, scenario_options  # noqa: PLC0415 (heavy)

    return monte_carlo.run_monte_carlo(
        scenario_options.chosen_scenario(scenario, steps=steps, sets=set_ or []),
        estimators,
        runs=runs,
        seed=seed,
        assumed=changes("--assume", assume or []),
        workers=monte_carlo.Workers(jobs, backend, scheduler),
        blocks=monte_carlo.Blocks(block_size, first_run, merge or [], fresh),
        out=out,
        as_json=as_json,
    )


@main.command(
    short_help="Write trajectories by the million.",
    help=_taught(
        "Drive many episodes of a scenario and write them as a data set: what was "
        "commanded, what was read, and the truth. Stopped or killed, the same command "
        "goes on where it stood, and the same command always gives the same bytes.",
        "slamgym generate loop --episodes 1000",
        "slamgym generate corridor --episodes 50 --controller random --format parquet",
        "slamgym generate loop --episodes 9 --set randomise.motion_std=[0.5,2]",
    ),
)
def generate(
    scenario: options.ScenarioName,
    *,
    episodes: options.Episodes,
    controller: options.ControllerName = "waypoints",
    seed: options.Seed = 0,
    format_: options.TrajectoryFormat = "npz",
    shard: options.EpisodesPerShard = None,
    steps: options.Steps = None,
    set_: options.ScenarioChanges = None,
    out: options.DatasetFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Generate trajectories."""
    from . import generate, scenario_options  # noqa: PLC0415 (heavy)

    world = scenario_options.chosen_scenario(scenario, steps=steps, sets=set_ or [])
    generate.write_trajectories(
        world,
        episodes=episodes,
        controller=controller,
        seed=seed,
        format=format_,
        episodes_per_shard=shard,
        out=out,
        as_json=as_json,
    )


@main.command(
    name="noise-study",
    short_help="Every noise times 10 and divided by 10.",
    help=_taught(
        "Multiply and divide each of σx, σy, σα, σβ, σr by 10, one by one. Of a log, "
        "only the filter changes its mind about the noise; of a scenario, world and "
        "filter change together, with the same random numbers. Draws all maps in one "
        "figure, and tables the areas of the final 3σ ellipses, the errors, and the "
        "NEES and NIS, which are 1 per degree of freedom for an honest filter.",
        "slamgym noise-study data.txt",
        "slamgym noise-study six_landmarks --seed 3 --out study",
        "slamgym noise-study six_landmarks --runs 100 -e ekf,invariant",
    ),
)
def noise_study(
    source: options.ScenarioOrLog,
    *,
    estimator: options.EstimatorName = "ekf",
    motion_std: options.MotionStd = None,
    measurement_std: options.MeasurementStd = None,
    initial_pose_std: options.InitialPoseStd = None,
    option: options.EstimatorOptions = None,
    seed: options.Seed = 0,
    steps: options.Steps = None,
    controller: options.ControllerName = "open_loop",
    set_: options.ScenarioChanges = None,
    runs: options.StudyRuns = 1,
    change: options.Changed = "all",
    jobs: options.Jobs = None,
    out: options.OutFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Run the study, and write figure and tables."""
    from ..runs.filter_settings import settings_for, settings_for_scenario  # noqa: PLC0415 (heavy)
    from . import noise_study, scenario_options  # noqa: PLC0415 (heavy)
    from .run_and_replay import read_any_log  # noqa: PLC0415 (heavy)

    chosen = assignments("--option", option or [])
    stds = _stds(motion_std, measurement_std, initial_pose_std)
    if noise_study.is_scenario(source):
        _refuse(stds, "a log; the filter knows the noise of a scenario")
        world = scenario_options.chosen_scenario(source, steps=steps, sets=set_ or [])
        if runs != 1:
            from . import noise_study_runs  # noqa: PLC0415 (heavy)

            noise_study_runs.study_effects(
                world,
                estimator,
                runs=runs,
                seed=seed,
                changed=change,
                jobs=jobs,
                out=out,
                as_json=as_json,
            )
            return
        settings = settings_for_scenario(world, estimator=estimator, options=chosen)
        planned = noise_study.scenario_study(
            world, settings, controller=controller, seed=seed
        )
    else:
        _refuse(_given(steps=steps, set=set_), "a scenario, not of a log")
        log = read_any_log(Path(source))
        settings = settings_for(log, estimator=estimator, options=chosen, **stds)
        planned = noise_study.log_study(log, settings)
    noise_study.write_study(planned, out, as_json=as_json)


@main.command(
    short_help="Film an episode as .gif or .mp4.",
    help=_taught(
        "Film a drive through a scenario: robot, readings and walls, and what "
        "a filter believes, with its 3σ ellipses.",
        "slamgym render loop --out loop.gif",
        "slamgym render corridor --out corridor.mp4 --fps 20 --controller waypoints",
    ),
)
def render(
    scenario: options.ScenarioName,
    *,
    out: options.FilmPath,
    estimator: options.ShownEstimatorName = None,
    option: options.EstimatorOptions = None,
    seed: options.Seed = 0,
    steps: options.Steps = None,
    controller: options.ControllerName = "open_loop",
    set_: options.ScenarioChanges = None,
    fps: options.FramesPerSecond = None,
    as_json: options.AsJson = False,
) -> None:
    """Film an episode."""
    from ..runs.filter_settings import settings_for_scenario  # noqa: PLC0415 (heavy)
    from . import render, scenario_options  # noqa: PLC0415 (heavy)

    world = scenario_options.chosen_scenario(scenario, steps=steps, sets=set_ or [])
    shown = estimator or ("ekf" if world.sensor.identities else "none")
    chosen = assignments("--option", option or [])
    render.film_episode(
        world,
        None
        if shown == "none"
        else settings_for_scenario(world, estimator=shown, options=chosen),
        controller=controller,
        seed=seed,
        fps=fps,
        out=out,
        as_json=as_json,
    )


@main.command(short_help="List the worlds there are.")
def scenarios(as_json: options.AsJson = False) -> None:
    """List the scenarios that come with slamgym, to run, to film, or to vary."""
    from . import listings  # noqa: PLC0415 (heavy)

    listings.show_scenarios(as_json=as_json)


@main.command(short_help="List the filters there are.")
def estimators(as_json: options.AsJson = False) -> None:
    """List the filters that come with slamgym."""
    from . import listings  # noqa: PLC0415 (heavy)

    listings.show_estimators(as_json=as_json)
