"""The arguments and options that several commands share, and how their values are read.

Each annotated type is one option with its help. The functions below them parse values
and choose scenarios, logs and filters by the names that the user gives.
"""

import json
import math
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ...envs.controllers import CONTROLLERS, Controller, make_controller
from ...estimator.check_estimator import find_breaches, listed
from ...estimator.registry import find_estimator, read_label
from ...sim_configs import Scenario, list_presets, load_scenario
from ...suggestions import closest
from ..logs.ground_truth import without_identities
from ..logs.importers import read_log
from ..logs.slamlog import SlamLog
from ..runs.filter_settings import FilterSettings, estimator_choices
from .program import BadInputError, BrokenFilterError
from .reporter import Reporter

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


# --------------------------------------------------------------------------------------
# Parse the values of options.


def given_options(**values: Any) -> dict[str, Any]:
    """Return the options that the user gave.

    Examples
    --------
    >>> given_options(gate_probability=0.99, noise_at_rest=None)
    {'gate_probability': 0.99}
    """
    return {name: value for name, value in values.items() if value is not None}


def standard_deviations(
    motion_std: str | None, measurement_std: str | None, initial_pose_std: str | None
) -> dict[str, tuple[float, ...]]:
    """Parse the standard deviations that the user gave, by the names of their options.

    Examples
    --------
    >>> standard_deviations("0.2,.1,1e-2", None, None)
    {'motion_std': (0.2, 0.1, 0.01)}
    >>> standard_deviations(None, "0.2,-1", None)
    Traceback (most recent call last):
    slamgym.experiments.command_line.program.BadInputError: --measurement-std must be \
2 numbers >= 0 with commas between, got '0.2,-1'
    """
    texts = {
        "motion_std": (motion_std, 3),
        "measurement_std": (measurement_std, 2),
        "initial_pose_std": (initial_pose_std, 3),
    }
    return {
        name: _numbers(f"--{name.replace('_', '-')}", text, count)
        for name, (text, count) in texts.items()
        if text is not None
    }


def _numbers(option: str, text: str, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(0 <= value < math.inf for value in values):
        raise BadInputError(
            f"{option} must be {count} numbers >= 0 with commas between, got {text!r}"
        )
    return values


def assignments(option: str, texts: Iterable[str] | None) -> dict[str, Any]:
    """Parse "key=value" with the value as in TOML; a bare word is a string.

    Examples
    --------
    >>> assignments("--option", ["gate_probability=0.99", "landmark_init=full"])
    {'gate_probability': 0.99, 'landmark_init': 'full'}
    """
    values: dict[str, Any] = {}
    for text in texts or ():
        key, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and key and value):
            raise BadInputError(f"{option} must be KEY=VALUE, got {text!r}")
        if key in values:
            raise BadInputError(f"{option} must name each key once, got {key} twice")
        values[key] = _toml_value(value)
    return values


def changes(option: str, texts: Iterable[str] | None) -> dict[str, Any]:
    """Parse "part.key=value" into nested mappings.

    Examples
    --------
    >>> changes("--set", ["sensor.max_range=4", "sensor.dropout=0.1", "steps=9"])
    {'sensor': {'max_range': 4, 'dropout': 0.1}, 'steps': 9}
    """
    nested: dict[str, Any] = {}
    for path, value in assignments(option, texts).items():
        *parts, key = path.split(".")
        place = nested
        for part in parts:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise BadInputError(f"{option} sets {part} and a part of it, {path}")
        place[key] = value
    return nested


def _toml_value(text: str) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    return table["value"] if len(table) == 1 else text


# --------------------------------------------------------------------------------------
# Scenarios and controllers by the names that the user gives.


def chosen_scenario(
    name: str, steps: int | None, sets: Iterable[str] | None
) -> Scenario:
    """Load a preset or a .toml file, with the changes of ``--steps`` and ``--set``.

    Raises
    ------
    ValueError
        If there is no such scenario, it is a log, or a change does not fit.
    """
    changed = changes("--set", sets)
    if steps is not None:
        changed["steps"] = steps
    _refuse_log(name)
    return load_scenario(name).with_changes(**changed)


def _refuse_log(name: str) -> None:
    """Refuse a file or folder that is no scenario, and name the command for logs."""
    path = Path(name)
    if name in list_presets() or path.suffix == ".toml" or not path.exists():
        return
    raise BadInputError(
        f"{name} is no scenario (a preset or a .toml file); to filter a log: slamgym "
        f"replay {name}"
    )


def chosen_controller(name: str, scenario: Scenario, seed: int) -> Controller:
    """Make a controller; a random one drives the same path for the same seed.

    Raises
    ------
    BadInputError
        If there is no such controller.
    """
    if name not in CONTROLLERS:
        hint, known = closest(name, CONTROLLERS), ", ".join(CONTROLLERS)
        raise BadInputError(f"unknown controller '{name}'{hint} (there are {known})")
    return make_controller(name, scenario, np.random.default_rng([seed, 1]))


def recorded(
    scenario: Scenario,
    controller: str,
    seed: int,
    progress: Callable[[int, int], object] | None = None,
) -> "SlamLog":
    """Record one episode with the controller of a name; see `record_episode`."""
    from ..logs.recording import record_episode

    driver = chosen_controller(controller, scenario, seed)
    return record_episode(scenario, driver, seed, progress=progress)


# --------------------------------------------------------------------------------------
# Read a log for a command, and note what its importer chose.


def read_any_log(
    path: Path,
    robot: int | None = None,
    *,
    truth: Path | None = None,
    noise_from_file: bool = False,
    hide_identities: bool = False,
) -> SlamLog:
    """Read a log of any known format, with its truth if that is in another file.

    ``hide_identities`` keeps the identities of its readings for scores alone.

    Raises
    ------
    BadInputError
        If a file cannot be opened, or does not fit into memory.
    LogError
        If one is malformed.
    """
    try:
        log = read_log(path, robot=robot, truth=truth, noise_from_file=noise_from_file)
    except OSError as error:
        reason, file = error.strerror or error, error.filename or path
        hint = ""
        if str(path) in list_presets():
            hint = f"; {path} is a scenario: slamgym run {path}"
        raise BadInputError(f"cannot read the log {file}: {reason}{hint}") from error
    except MemoryError as error:
        raise BadInputError(f"the log {path} does not fit into memory") from error
    return without_identities(log) if hide_identities else log


def note_choices(log: SlamLog, reporter: Reporter) -> None:
    """Note what the importer of a log omitted, and where its noise is from."""
    if "left_out" in log.header:
        reporter.note(f"left out of the log: {log.header['left_out']}")
    if "noise" in log.header and "motion_std" in log.header:
        reporter.note(f"noise {log.header['noise']}")


def note_noise(
    log: SlamLog, settings: FilterSettings, given: Collection[str], reporter: Reporter
) -> None:
    """Note the noise of a log's filter, without what the user gave."""
    options = {
        "range_std_per_metre": settings.options.get("range_std_per_metre"),
        "bearing_std_metres": settings.options.get("bearing_std_metres"),
    }
    values = {
        "motion_std": settings.motion_std,
        "measurement_std": settings.measurement_std,
        "initial_pose_std": settings.initial_pose_std,
        **{name: (std,) for name, std in options.items() if std},
    }
    found = [
        f"{name} {','.join(f'{std:.6g}' for std in stds)}"
        for name, stds in values.items()
        if name not in given and (any(stds) or name != "initial_pose_std")
    ]
    if found:
        reporter.note(f"noise of {log.name}: {'; '.join(found)}")


# --------------------------------------------------------------------------------------
# Filters by the names that the user gives, with options in brackets.


def chosen_filters(
    estimators: str,
    options: Mapping[str, Any],
    settings: Callable[..., FilterSettings],
) -> dict[str, FilterSettings]:
    """Set up one or more filters, by the labels that the user gave.

    Parameters
    ----------
    estimators : str
        Names separated by commas, such as "ekf,invariant[iterations=3]".
    options : mapping
        Options of all of them; options in brackets take precedence.
    settings : callable
        Called with ``estimator`` and ``options``.

    Raises
    ------
    ValueError
        If there is none, or one is unknown, malformed, named twice, or cannot run.

    Examples
    --------
    >>> from functools import partial
    >>> from slamgym.experiments.runs import settings_for_scenario
    >>> from slamgym.sim_configs import load_scenario
    >>> set_up = partial(settings_for_scenario, load_scenario("loop"))
    >>> list(chosen_filters("ekf,invariant[iterations=3]", {}, set_up))
    ['ekf', 'invariant[iterations=3]']
    """
    refuse_broken(estimators, options)
    return {
        choice.label: settings(
            estimator=choice.name, options={**options, **choice.options}
        )
        for choice in estimator_choices(estimators)
    }


def refuse_broken(estimators: str, options: Mapping[str, Any] | None = None) -> None:
    """Check the user's own filters among some labels, before any work.

    Parameters
    ----------
    estimators : str
        Labels separated by commas.
    options : mapping, optional
        Options of all of them.

    Raises
    ------
    BrokenFilterError
        If a filter cannot run, with all reasons.
    ValueError
        If a label is unknown or malformed.
    """
    for _, name, own in estimator_choices(estimators):
        if ":" in name and not name.startswith("slamgym."):
            given = {**(options or {}), **own}
            given.pop("management", None)  # it is around the filter
            factory = partial(find_estimator(name), **given)
            with Reporter(as_json=False).note_if_compiling("the filter"):
                findings = find_breaches(factory, ("required",))
            if findings:
                raise BrokenFilterError(listed(factory, findings))


def with_options(label: str, texts: Sequence[str]) -> str:
    """Write options of all filters, as "key=value", into the brackets of one label.

    Examples
    --------
    >>> with_options("ekf[iterations=3]", ["iterations=1", "landmark_init=full"])
    'ekf[iterations=3,landmark_init="full"]'
    """
    _, own = read_label(label)
    given = assignments("--option", texts)
    more = [
        f"{key}={json.dumps(value)}" if isinstance(value, str) else text
        for text, (key, value) in zip(texts, given.items(), strict=True)
        if key not in own
    ]
    if not more:
        return label
    name, _, inside = label.removesuffix("]").partition("[")
    return f"{name}[{','.join([inside, *more] if own else more)}]"


def tested_filters(labels: Sequence[str]) -> list[str]:
    """Return the filters for a Monte Carlo that tests these; one gets a companion.

    Examples
    --------
    >>> tested_filters(["invariant"]), tested_filters(["mine:Filter"])
    (['ekf', 'invariant'], ['mine:Filter', 'invariant'])
    """
    if len(labels) > 1:
        return list(labels)
    (label,) = labels
    if label in ("ekf", "invariant"):
        return ["ekf", "invariant"]
    return [label, "invariant"]
