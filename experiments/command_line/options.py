"""The arguments and options that several commands share, and how their values are read.

Each annotated type is one option with its help. The functions below them parse values
and choose scenarios, logs and filters by the names that the user gives.
"""

import contextlib
import inspect
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import numpy as np
import typer

from ...sim_configs import Scenario, list_presets, load_scenario
from ...sim_configs.field_types import unknown_choice
from .commands import BadInputError, BrokenFilterError, Reporter, docstring_of

if TYPE_CHECKING:
    from ...envs.controllers import Controller
    from ..logs.slamlog import SlamLog
    from ..run_and_replay.filter_settings import FilterSettings

_Function = TypeVar("_Function", bound=Callable[..., Any])

REQUIRED = MISSING


def declared(
    default: object, form: str, shown: str | bool = True, *, min: int | None = None
) -> Any:
    """Declare an option of a command as a field of :class:`Options` or a subclass.

    The help is the field's text in the section "Attributes" of the class.

    Parameters
    ----------
    default : object
        Its value by default; `REQUIRED` if it must be given.
    form : str
        Its names, then the placeholder of its value, as in "--jobs -j N". Without a
        name, the option is named after the field.
    shown : str or bool
        What the help shows as the default; True for the default itself.
    min : int, optional
        The least value.
    """
    words = form.split()
    names = [word for word in words if word.startswith("-")]
    shown_value = next((word for word in words if word not in names), None)
    metavar = "N" if shown_value is None and type(default) is int else shown_value
    option = typer.Option(*names, metavar=metavar, show_default=shown, min=min)
    return field(default=default, metadata={"option": option})


ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A preset (see: slamgym scenarios) or a .toml file."
    ),
]
LogFile = Annotated[
    Path, typer.Argument(metavar="LOG", help="A log of any format that replay reads.")
]
FilesOfEstimates = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILES",
        help="Files of estimates, or folders of them; each folder is an estimator.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options that commands share, as the user gave them; the others' defaults.

    A command takes some of them, see :func:`takes`. Its own ones are in a subclass.

    Attributes
    ----------
    estimator
        A filter (see: slamgym estimators), or your own "module:Class", with or without
        options, as in "invariant[iterations=3]".
    estimators
        Filters separated by commas, such as "ekf,invariant[iterations=3]", or your own
        "module:Class"; options in brackets.
    labels
        Filters separated by commas, such as "ekf,invariant[iterations=3]", or your own
        "module:Class". run.html and comparison.png show all of them; the other files
        and numbers are those of the first.
    option_texts
        An option of all filters, such as gate_probability=0.999; options in brackets
        take precedence. May be repeated.
    motion_std
        σx,σy,σα of the motion noise in the robot's frame [m, m, rad], per unit of the
        log's time: a step or a second.
    measurement_std
        σβ,σr of bearing and range [rad, m].
    initial_pose_std
        σx,σy,σθ of the first pose [m, m, rad].
    landmark_init
        How a landmark enters the map: full correlates it with the pose; independent, as
        in the homework, does not; delayed waits for readings from several poses.
    gate_probability
        Reject readings outside this probability region of their innovation.
    range_std_per_metre
        Part of σr that grows with the range: σr + K r.
    noise_at_rest
        Whether there is motion noise while the odometry reports no motion.
    hide_identities
        Let the filter associate the readings of a log that identifies them.
    robot
        Which robot of a UTIAS folder.
    truth
        The true path: TUM, EuRoC, KITTI, csv, or a log; of a graph also another graph.
    noise_from_file
        Take the noise from the information matrices of an iSAM or g2o text.
    seed
        Seed of all random numbers.
    steps
        Steps to drive.
    controller
        open_loop applies the scenario's controls, waypoints steers along their nominal
        path, random drives at random.
    set_
        A change of the scenario, such as sensor.max_range=4. May be repeated.
    resolution
        In scores of association, true landmarks nearer to each other than R count as
        one [m].
    jobs
        Worker processes, -1 for one on each core.
    backend
        Where the workers run: loky, on this machine; dask, on a cluster.
    scheduler
        The Dask cluster.
    out
        The folder to write: new, empty, or with earlier output of slamgym, which is
        replaced unless you changed it.
    every_step
        Draw the map after every step, into map_steps/.
    rerun
        Also write the content of run.html as a recording for the viewer rerun (.rrd;
        needs slamgym[viewer]).
    as_json
        Print one JSON object and nothing else.
    """

    estimator: str = declared("invariant", "--estimator -e NAME")
    estimators: str = declared("ekf,invariant", "--estimators -e NAMES")
    labels: str = declared("invariant", "--estimator -e NAMES")
    option_texts: list[str] | None = declared(None, "--option KEY=VALUE")
    motion_std: str | None = declared(None, "A,B,C", "from the log")
    measurement_std: str | None = declared(None, "A,B", "from the log")
    initial_pose_std: str | None = declared(None, "A,B,C", "from the log, else 0,0,0")
    landmark_init: str | None = declared(None, "full|independent|delayed", "full")
    gate_probability: float | None = declared(None, "P", "none rejected")
    range_std_per_metre: float | None = declared(None, "K", "from the log, else 0")
    noise_at_rest: bool | None = declared(
        None, "--noise-at-rest/--no-noise-at-rest", "from the log, else no"
    )
    hide_identities: bool = declared(False, "--hide-identities")
    robot: int | None = declared(None, "K", "the lowest number")
    truth: Path | None = declared(None, "FILE", "none")
    noise_from_file: bool = declared(False, "--noise-from-file")
    seed: int = declared(0, "", min=0)
    steps: int | None = declared(None, "N", "those of the scenario")
    controller: str = declared("open_loop", "NAME")
    set_: list[str] | None = declared(None, "--set KEY=VALUE")
    resolution: float = declared(0.0, "R", "all are distinct")
    jobs: int | None = declared(None, "--jobs -j N", "none, this process only")
    backend: str | None = declared(None, "loky|dask")
    scheduler: str | None = declared(None, "ADDRESS", "a cluster on this machine")
    out: Path | None = declared(None, "DIR", "results/<name>-<estimator>")
    every_step: bool | None = declared(
        None, "--every-step/--no-every-step", "if there are 60 steps or fewer"
    )
    rerun: Path | None = declared(None, "FILE", "none")
    as_json: bool = declared(False, "--json")

    def reporter(self) -> Reporter:
        """Return what prints the progress and the results."""
        return Reporter(as_json=self.as_json)

    def scenario(self, name: str) -> Scenario:
        """Load a preset or a .toml file, with the changes of ``--steps`` and ``--set``.

        Raises
        ------
        ValueError
            If there is no such scenario, it is a log, or a change does not fit.
        """
        changed = changes("--set", self.set_)
        if self.steps is not None:
            changed["steps"] = self.steps
        _refuse_log(name)
        world = load_scenario(name).with_changes(**changed)
        if ":" in world.sensor.kind:  # before workers copy the import path
            from ...envs.noise_streams import part_of_sensor

            part_of_sensor(world.sensor.kind, "h")
        return world

    def driver(self, scenario: Scenario) -> "Controller":
        """Make the controller; a random one drives the same path for the same seed.

        Raises
        ------
        BadInputError
            If there is no such controller.
        """
        from ...envs.controllers import CONTROLLERS, make_controller

        if self.controller not in CONTROLLERS:
            message = unknown_choice("--controller", self.controller, CONTROLLERS)
            raise BadInputError(message)
        random = np.random.default_rng([self.seed, 1])
        return make_controller(self.controller, scenario, random)

    def record(
        self, scenario: Scenario, progress: Callable[[int, int], object] | None = None
    ) -> "SlamLog":
        """Record one episode with the controller; see `record_episode`."""
        from ..logs.recording import record_episode

        driver = self.driver(scenario)
        return record_episode(scenario, driver, self.seed, progress=progress)

    def read(self, path: Path, reporter: Reporter) -> "SlamLog":
        """Read a log of any known format, with its truth if that is in another file.

        Notes what the importer omitted, and where truth and noise come from.

        Raises
        ------
        BadInputError
            If a file cannot be opened, or does not fit into memory.
        LogError
            If one is malformed.
        """
        from ..logs.ground_truth import without_identities
        from ..logs.importers import read_log

        try:
            log = read_log(path, **self._given("robot", "truth", "noise_from_file"))
        except OSError as error:
            why, file = error.strerror or error, error.filename or path
            hint = ""
            if str(path) in list_presets():
                hint = f"; {path} is a scenario: slamgym run {path}"
            raise BadInputError(f"cannot read the log {file}: {why}{hint}") from error
        except MemoryError as error:
            raise BadInputError(f"the log {path} does not fit into memory") from error
        if "left_out" in log.header:
            reporter.note(f"left out of the log: {log.header['left_out']}")
        found, start = log.header.get("truth", "none"), log.header.get("start_from")
        if self.truth is None and start == "ground truth" and found != "none":
            reporter.note(f"truth: {found}; the log starts at the true pose")
        if "noise" in log.header and "motion_std" in log.header:
            reporter.note(f"noise {log.header['noise']}")
        return without_identities(log) if self.hide_identities else log

    def stds(self) -> dict[str, Any]:
        """Parse the standard deviations that the user gave.

        Examples
        --------
        >>> Options(motion_std="0.2,.1,1e-2").stds()
        {'motion_std': (0.2, 0.1, 0.01)}
        >>> Options(measurement_std="0.2,-1").stds()
        Traceback (most recent call last):
        slamgym.experiments.command_line.commands.BadInputError: --measurement-std \
must be 2 numbers >= 0 with commas between, got '0.2,-1'
        """
        counts = {"motion_std": 3, "measurement_std": 2, "initial_pose_std": 3}
        return {
            name: _numbers(f"--{name.replace('_', '-')}", text, counts[name])
            for name, text in self._given(*counts).items()
        }

    def noise_arguments(self) -> list[str]:
        """Return the noise that the user gave, as arguments for another command.

        Examples
        --------
        >>> noise = "range_noise_at=reading"
        >>> given = Options(noise_at_rest=False, option_texts=[noise, "iterations=3"])
        >>> given.noise_arguments()
        ['--no-noise-at-rest', '--option=range_noise_at=reading']
        """
        from ...estimator.models.sensors import NUMBERS

        stds = "motion_std", "measurement_std", "initial_pose_std"
        given = self._given(*stds, "range_std_per_metre", "noise_at_rest")
        arguments = []
        for name, value in given.items():
            option = name.replace("_", "-")
            if isinstance(value, bool):
                arguments.append(f"--{option}" if value else f"--no-{option}")
            else:
                arguments.append(f"--{option}={value}")
        noises = {*NUMBERS, "noise_at_rest"}
        for text in self.option_texts or ():
            if text.partition("=")[0].strip() in noises:
                arguments.append(f"--option={text}")
        return arguments

    def named_options(self) -> dict[str, Any]:
        """Return the options of filters that the user gave by their own names.

        Examples
        --------
        >>> Options(gate_probability=0.99).named_options()
        {'gate_probability': 0.99}
        """
        shared = "range_std_per_metre", "noise_at_rest"
        return self._given("landmark_init", "gate_probability", *shared)

    def _given(self, *names: str) -> dict[str, Any]:
        """Return those of some options that the user gave."""
        values = {name: getattr(self, name) for name in names}
        return {name: value for name, value in values.items() if value is not None}

    def filter_options(self) -> dict[str, Any]:
        """Return all options of filters that the user gave."""
        return self.named_options() | assignments("--option", self.option_texts)

    def filters(
        self, settings: "Callable[..., FilterSettings]"
    ) -> "dict[str, FilterSettings]":
        """Set up the filters by their labels; options in brackets take precedence.

        Parameters
        ----------
        settings : callable
            Called with ``estimator`` and ``options``.

        Raises
        ------
        ValueError
            If there is none, or one is unknown, malformed, named twice, or cannot run.

        Examples
        --------
        >>> from functools import partial
        >>> from slamgym.experiments.run_and_replay import settings_for_scenario
        >>> set_up = partial(settings_for_scenario, load_scenario("loop"))
        >>> list(Options(labels="ekf,invariant[iterations=3]").filters(set_up))
        ['ekf', 'invariant[iterations=3]']
        """
        from ..run_and_replay.filter_settings import estimator_choices

        options = self.filter_options()
        refuse_broken(self.labels, options)
        return {
            choice.label: settings(
                estimator=choice.name, options={**options, **choice.options}
            )
            for choice in estimator_choices(self.labels)
        }


def takes(names: str, **defaults: Any) -> Callable[[_Function], Callable[..., Any]]:
    """Give a command options, as its argument ``given`` of :class:`Options`.

    Parameters
    ----------
    names : str
        The fields of the class of ``given`` that the command takes, in the order of the
        help, with white space between.
    defaults
        Where they differ from those of the class.
    """

    def expand(function: _Function) -> Callable[..., Any]:
        parameters = dict(inspect.signature(function).parameters)
        kind = parameters.pop("given").annotation
        declared, texts = {each.name: each for each in fields(kind)}, _help_texts(kind)
        taken = names.split()

        @wraps(function)
        def run(*arguments: Any, **values: Any) -> Any:
            options = {
                name: _place(name, values.pop(name)) for name in taken if name in values
            }
            return function(*arguments, given=kind(**defaults | options), **values)

        every = [
            *parameters.values(),
            *(_parameter(declared[name], texts.get(name), defaults) for name in taken),
        ]
        run.__signature__ = inspect.Signature(every)  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in every}
        return run

    return expand


def _place(option: str, value: Any) -> Any:
    """Return the value of an option; of a path, with ~ as the home of the user."""
    if not isinstance(value, Path):
        return value
    try:
        str(value).encode()
    except UnicodeEncodeError:
        name = f"--{option.replace('_', '-')}"
        raise BadInputError(f"{name} must be text in UTF-8, got {value!a}") from None
    return value.expanduser()


def _help_texts(kind: type) -> dict[str, str]:
    """Return the texts of the attributes in the docstrings of a class and its bases."""
    texts = {}
    for each in reversed(kind.__mro__):
        listed = docstring_of(each).partition("\nAttributes\n")[2]
        for name, text in re.findall(r"^(\w+)\n((?: +.*\n?)+)", listed, re.MULTILINE):
            texts[name] = " ".join(text.split())
    return texts


def _parameter(
    option: Field[Any], text: str | None, defaults: Mapping[str, Any]
) -> inspect.Parameter:
    """Return the parameter that typer reads an option from."""
    default = defaults.get(option.name, option.default)
    read = copy(option.metadata["option"])
    read.help = text
    return inspect.Parameter(
        option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if default is REQUIRED else default,
        annotation=Annotated[option.type, read],
    )


# --------------------------------------------------------------------------------------
# Parse the values of options.


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
    >>> changes("--set", ["sensor.max_range=4", "sensor.dropout=.1", "steps=9"])
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
    for written in (text, _BARE_POINT.sub("0.", text)):  # TOML wants 0.1 for .1
        with contextlib.suppress(ValueError, RecursionError):
            table = tomllib.loads(f"value = {written}")
            return table["value"] if len(table) == 1 else text
    return text


_BARE_POINT = re.compile(r"(?<![\w.])\.(?=\d)")


# --------------------------------------------------------------------------------------
# Logs and filters as the user names them.


def _refuse_log(name: str) -> None:
    """Refuse a file or folder that is no scenario, and name the command for logs."""
    path = Path(name)
    if name and name not in list_presets() and path.suffix != ".toml" and path.exists():
        raise BadInputError(
            f"{name} is no scenario (a preset or a .toml file); to filter a log: "
            f"slamgym replay {name}"
        )


def note_noise(
    log: "SlamLog", settings: "FilterSettings", given: set[str], reporter: Reporter
) -> None:
    """Note the noise of a log's filter, without what the user gave."""
    names = ("motion_std", "measurement_std", "initial_pose_std")
    values = {name: getattr(settings, name) for name in names}
    for name in ("range_std_per_metre", "bearing_std_metres"):
        if std := settings.options.get(name):
            values[name] = (std,)
    found = [
        f"{name} {','.join(f'{std:.6g}' for std in stds)}"
        for name, stds in values.items()
        if name not in given and (any(stds) or name != "initial_pose_std")
    ]
    if found:
        reporter.note(f"noise of {log.name}: {'; '.join(found)}")


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
    from ...estimator.check_estimator import find_breaches, listed
    from ...estimator.registry import find_estimator
    from ..run_and_replay.filter_settings import estimator_choices

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
    from ...estimator.registry import read_label

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


def compared_filters(labels: Sequence[str]) -> list[str]:
    """Return the filters for a Monte Carlo that tests these; one gets a companion.

    Examples
    --------
    >>> compared_filters(["invariant"]), compared_filters(["mine:Filter"])
    (['ekf', 'invariant'], ['mine:Filter', 'invariant'])
    """
    if len(labels) > 1:
        return list(labels)
    (label,) = labels
    if label in ("ekf", "invariant"):
        return ["ekf", "invariant"]
    return [label, "invariant"]
