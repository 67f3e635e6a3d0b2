"""Arguments and options of the command line, each with its help."""

from pathlib import Path
from typing import Annotated

import typer

_REPEATED = "May be repeated."

ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A preset (see: slamgym scenarios) or a .toml file."
    ),
]
LogPath = Annotated[
    Path,
    typer.Argument(
        metavar="LOG",
        help="A slamlog CSV, a course data.txt, a Freiburg sensor.dat, iSAM or g2o "
        "text, or a UTIAS MR.CLAM folder: the content tells which.",
    ),
]
ScenarioOrLog = Annotated[
    str,
    typer.Argument(metavar="SCENARIO|LOG", help="A preset, a .toml file, or a log."),
]
EstimatorName = Annotated[
    str,
    typer.Option(
        "--estimator",
        "-e",
        metavar="NAME",
        help='A filter (see: slamgym estimators), or "module:Class" of your own.',
    ),
]
ShownEstimatorName = Annotated[
    str | None,
    typer.Option(
        "--estimator",
        "-e",
        metavar="NAME",
        help='The filter whose belief is drawn, or "none".',
        show_default="ekf where readings carry identities",
    ),
]
EstimatorOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="KEY=VALUE",
        help=f"An option of the filter, such as gate_probability=0.999. {_REPEATED}",
    ),
]
ScenarioChanges = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help=f"A change of the scenario, such as sensor.max_range=4. {_REPEATED}",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Fixes everything random.")]
Steps = Annotated[
    int | None,
    typer.Option(help="Steps to drive.", show_default="those of the scenario"),
]
ControllerName = Annotated[
    str,
    typer.Option(
        "--controller",
        metavar="NAME",
        help="open_loop follows the scenario's controls blindly, waypoints steers "
        "along the path they mean, random wanders.",
    ),
]
OutFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="The folder to write. What slamgym wrote there before is replaced.",
        show_default="results/<name>-<estimator>",
    ),
]
EveryStep = Annotated[
    bool | None,
    typer.Option(
        "--every-step/--no-every-step",
        help="Draw the map after every step, into map_steps/.",
        show_default="if there are 60 steps or fewer",
    ),
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print one JSON object and nothing else.")
]
MotionStd = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C",
        help="σx,σy,σα of the motion noise in the robot's frame [m, m, rad], per unit "
        "of the log's time: a step or a second.",
        show_default="from the log",
    ),
]
MeasurementStd = Annotated[
    str | None,
    typer.Option(
        metavar="A,B",
        help="σβ,σr of bearing and range [rad, m].",
        show_default="from the log",
    ),
]
InitialPoseStd = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C",
        help="σx,σy,σθ of the first pose [m, m, rad].",
        show_default="from the log, else 0,0,0",
    ),
]
LandmarkInit = Annotated[
    str | None,
    typer.Option(
        metavar="full|independent",
        help="How a landmark enters the map: full correlates it with the pose it was "
        "seen from; independent, as in the homework, does not.",
        show_default="full",
    ),
]
GateProbability = Annotated[
    float | None,
    typer.Option(
        metavar="P",
        help="Reject readings outside this probability region of their innovation.",
        show_default="none rejected",
    ),
]
RangeStdPerMetre = Annotated[
    float | None,
    typer.Option(
        metavar="K",
        help="Part of σr that grows with the range: σr + K r.",
        show_default="from the log, else 0",
    ),
]
NoiseAtRest = Annotated[
    bool | None,
    typer.Option(
        "--noise-at-rest/--no-noise-at-rest",
        help="Whether the pose gets uncertain while the odometry reports no motion.",
        show_default="from the log, else not",
    ),
]
Robot = Annotated[
    int | None,
    typer.Option(
        metavar="K",
        help="Which robot of a UTIAS folder.",
        show_default="the lowest number",
    ),
]
FilmPath = Annotated[
    Path, typer.Option(metavar="FILE", help="The .gif or .mp4 file to write.")
]
FramesPerSecond = Annotated[
    float | None,
    typer.Option(
        metavar="N",
        help="Frames, that is steps, per second.",
        show_default="so that it lasts 12 s",
    ),
]
EstimatorNames = Annotated[
    str,
    typer.Option(
        "--estimators",
        "-e",
        metavar="NAMES",
        help='Filters with commas between, such as "ekf,invariant[iterations=3]" or '
        '"module:Class" of your own; options stand in brackets.',
    ),
]
Runs = Annotated[
    int,
    typer.Option(
        help="How many; run i is the world of seed SEED + i, so that seeds closer "
        "than this share worlds."
    ),
]
AssumedChanges = Annotated[
    list[str] | None,
    typer.Option(
        "--assume",
        metavar="KEY=VALUE",
        help="A change of the scenario that only the filters are told of, such as "
        f"motion.std=[0.1,0.1,0.1]. {_REPEATED}",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        "-j",
        metavar="N",
        help="Worker processes, -1 for one on each core.",
        show_default="this process, its filters on all cores",
    ),
]
Backend = Annotated[
    str | None,
    typer.Option(
        metavar="loky|dask|ray",
        help="Where the workers are: loky, on this machine; dask or ray, on a cluster.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Of the Dask or Ray cluster.",
        show_default="a cluster of this machine",
    ),
]
RunsPerBlock = Annotated[
    int, typer.Option(metavar="N", help="Runs done and written at a time.")
]
FirstRun = Annotated[
    int,
    typer.Option(
        metavar="N",
        help="Leave the runs below N, a multiple of the block size, to others.",
    ),
]
MergedFolders = Annotated[
    list[Path] | None,
    typer.Option(
        "--merge",
        metavar="DIR",
        help=f"Take over what another machine has done of this job. {_REPEATED}",
    ),
]
Fresh = Annotated[
    bool, typer.Option("--fresh", help="Remove earlier results in the folder first.")
]
ResumableFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="The folder to write. A job that was stopped there goes on, and more runs "
        "build on those there are.",
        show_default="results/monte-carlo-<scenario>",
    ),
]
StudyRuns = Annotated[
    int,
    typer.Option(
        help="Of a scenario: more than one asks for a Monte Carlo of each change."
    ),
]
Changed = Annotated[
    str,
    typer.Option(
        "--change",
        metavar="both|world|filter|all",
        help="With --runs: whether noises change in world and filter, in the world "
        "alone, or in what the filter is told.",
    ),
]
Episodes = Annotated[
    int,
    typer.Option(
        min=1, metavar="N", help="How many to drive; episode i has seed SEED + i."
    ),
]
TrajectoryFormat = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="NAME",
        help="npz, parquet or minari hold everything; slamlog, g2o and tum what their "
        "readers know.",
    ),
]
EpisodesPerShard = Annotated[
    int | None,
    typer.Option(
        "--shard",
        min=1,
        metavar="N",
        help="Episodes in each file or folder of the data set.",
        show_default="100, fewer if they are large",
    ),
]
DatasetFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="The folder to write: new, empty, or begun by the same command, which "
        "then goes on.",
        show_default="results/<name>-<controller>-<format>",
    ),
]
