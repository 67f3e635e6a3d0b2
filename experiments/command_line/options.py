"""The arguments and options that several commands share, each with its help."""

from pathlib import Path
from typing import Annotated, Any

import typer

REPEATED = "May be repeated."


def option(
    form: str, text: str, default: str | bool = True, *, min: int | None = None
) -> Any:
    """Describe an option of a command.

    Parameters
    ----------
    form : str
        Its names, then the placeholder of its value, as in "--jobs -j N". Without a
        name, the option is named after the parameter.
    text : str
        The help.
    default : str or bool
        What the help shows as the default; True for the default itself.
    min : int, optional
        The least value.
    """
    words = form.split()
    names = [word for word in words if word.startswith("-")]
    value = [word for word in words if word not in names]
    metavar = value[0] if value else None
    return typer.Option(
        *names, metavar=metavar, help=text, show_default=default, min=min
    )


ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A preset (see: slamgym scenarios) or a .toml file."
    ),
]
LogFile = Annotated[
    Path, typer.Argument(metavar="LOG", help="A log of any format that replay reads.")
]
EstimatorName = Annotated[
    str,
    option(
        "--estimator -e NAME",
        'A filter (see: slamgym estimators), or your own "module:Class", with or '
        'without options, as in "invariant[iterations=3]".',
    ),
]
EstimatorNames = Annotated[
    str,
    option(
        "--estimator -e NAMES",
        'Filters separated by commas, such as "ekf,invariant[iterations=3]", or your '
        'own "module:Class". run.html and comparison.png show all of them; the other '
        "files and numbers are those of the first.",
    ),
]
EstimatorOptions = Annotated[
    list[str] | None,
    option(
        "--option KEY=VALUE",
        "An option of all filters, such as gate_probability=0.999; options in brackets "
        f"take precedence. {REPEATED}",
    ),
]
ScenarioChanges = Annotated[
    list[str] | None,
    option(
        "--set KEY=VALUE",
        f"A change of the scenario, such as sensor.max_range=4. {REPEATED}",
    ),
]
Seed = Annotated[int, option("", "Seed of all random numbers.", min=0)]
Steps = Annotated[int | None, option("", "Steps to drive.", "those of the scenario")]
ControllerName = Annotated[
    str,
    option(
        "NAME",
        "open_loop applies the scenario's controls, waypoints steers along their "
        "nominal path, random drives at random.",
    ),
]
TruthFile = Annotated[
    Path | None,
    option(
        "FILE",
        "A graph file with the true poses of an iSAM or g2o text, by their ids.",
        "none",
    ),
]
NoiseFromFile = Annotated[
    bool,
    option(
        "--noise-from-file",
        "Take the noise from the information matrices of an iSAM or g2o text.",
    ),
]
OutFolder = Annotated[
    Path | None,
    option(
        "DIR",
        "The folder to write: new, empty, or with earlier output of slamgym, which is "
        "replaced unless you changed it.",
        "results/<name>-<estimator>",
    ),
]
RerunFile = Annotated[
    Path | None,
    option(
        "FILE",
        "Also write the content of run.html as a recording for the viewer rerun (.rrd; "
        "needs slamgym[viewer]).",
        "none",
    ),
]
EveryStep = Annotated[
    bool | None,
    option(
        "--every-step/--no-every-step",
        "Draw the map after every step, into map_steps/.",
        "if there are 60 steps or fewer",
    ),
]
AsJson = Annotated[bool, option("--json", "Print one JSON object and nothing else.")]
MotionStd = Annotated[
    str | None,
    option(
        "A,B,C",
        "σx,σy,σα of the motion noise in the robot's frame [m, m, rad], per unit of "
        "the log's time: a step or a second.",
        "from the log",
    ),
]
MeasurementStd = Annotated[
    str | None,
    option("A,B", "σβ,σr of bearing and range [rad, m].", "from the log"),
]
InitialPoseStd = Annotated[
    str | None,
    option(
        "A,B,C", "σx,σy,σθ of the first pose [m, m, rad].", "from the log, else 0,0,0"
    ),
]
LandmarkInit = Annotated[
    str | None,
    option(
        "full|independent",
        "How a landmark enters the map: full correlates it with the pose; "
        "independent, as in the homework, does not.",
        "full",
    ),
]
GateProbability = Annotated[
    float | None,
    option(
        "P",
        "Reject readings outside this probability region of their innovation.",
        "none rejected",
    ),
]
RangeStdPerMetre = Annotated[
    float | None,
    option(
        "K",
        "Part of σr that grows with the range: σr + K r.",
        "from the log, else 0",
    ),
]
NoiseAtRest = Annotated[
    bool | None,
    option(
        "--noise-at-rest/--no-noise-at-rest",
        "Whether there is motion noise while the odometry reports no motion.",
        "from the log, else not",
    ),
]
HideIdentities = Annotated[
    bool,
    option(
        "--hide-identities",
        "Let the filter associate the readings of a log that identifies them.",
    ),
]
Resolution = Annotated[
    float,
    option(
        "R",
        "In scores of association, true landmarks nearer to each other than R count as "
        "one [m].",
        "each counts",
    ),
]
Jobs = Annotated[
    int | None,
    option(
        "--jobs -j N",
        "Worker processes, -1 for one on each core.",
        "this process alone",
    ),
]
Backend = Annotated[
    str | None,
    option(
        "loky|dask|ray",
        "Where the workers run: loky, on this machine; dask or ray, on a cluster.",
    ),
]
Scheduler = Annotated[
    str | None,
    option("ADDRESS", "The Dask or Ray cluster.", "a cluster of this machine"),
]
RobotNumber = Annotated[
    int | None,
    option("K", "Which robot of a UTIAS folder.", "the lowest number"),
]
