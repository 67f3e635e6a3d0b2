"""The arguments and options that several commands share, each with its help."""

from pathlib import Path
from typing import Annotated

import typer

REPEATED = "May be repeated."

ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A preset (see: slamgym scenarios) or a .toml file."
    ),
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
EstimatorOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="KEY=VALUE",
        help=f"An option of the filter, such as gate_probability=0.999. {REPEATED}",
    ),
]
ScenarioChanges = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help=f"A change of the scenario, such as sensor.max_range=4. {REPEATED}",
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
