"""Check an estimator against the interface of :class:`SlamEstimator`.

A check is a function that makes estimators, calls them and yields a message for each
finding. ``CHECKS`` lists the checks by level. The checks use a :class:`Trial`, which
turns every exception of the estimator into a finding.
"""

import inspect
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ..arrays import Array
from .covariance_checks import step_mistakes
from .interface import Belief, SlamEstimator, UpdateReport
from .models.bearing_range import predict_measurement, wrap_angle
from .models.motions import predict_pose
from .registry import find_estimator, read_label

__all__ = ["EstimatorContractError", "Finding", "check_estimator", "find_breaches"]
__dir__ = __all__.copy

Factory = Callable[..., Any]
Level = Literal["required", "correct", "recommended"]

LANDMARKS = np.array([[4.0, 1.0], [2.0, -3.0], [-1.0, 4.0], [6.0, 5.0]])
IDS = [0, 1, 2, 3]
NOISE = {"motion_std": (0.05, 0.02, 0.02), "measurement_std": (0.02, 0.05)}
START = {"initial_pose": (0.0, 0.0, 0.0), "initial_pose_std": (0.0, 0.0, 0.0)}

_NEEDED = ("reset", "predict", "update", "belief")
_SAVING = ("state_dict", "load_state_dict")
_PACKAGE = str(Path(__file__).parents[1])
_HEADINGS: dict[Level, str] = {
    "required": "{} cannot run in slamgym:",
    "correct": "{} computes wrong beliefs:",
    "recommended": "Recommended, but not needed to run:",
}
_INTERFACE = """\
The methods of an estimator (state_dict and load_state_dict are recommended):
  __init__(motion_std, measurement_std, initial_pose=…, initial_pose_std=…)
  reset(pose, pose_std)                 start a new run with an empty map
  predict(odometry, dt=1.0)             odometry (d, α)
  update(measurements, landmark_ids)    rows (bearing, range); returns UpdateReport()
  belief()                              returns Belief(mean, covariance, landmark_ids)
  state_dict(), load_state_dict(state)  arrays by name; landmark management needs them
Belief and UpdateReport are in slamgym.estimator; the mean is (x, y, θ, l1x, l1y, …)."""


class Finding(NamedTuple):
    """One result of the checks."""

    #: "required" to run at all, "correct" for right beliefs, or "recommended".
    level: Level
    #: The method, the expected result, and what the method did.
    message: str

    def __str__(self) -> str:
        return f"{self.level}: {self.message}"


class EstimatorContractError(AssertionError):
    """An estimator breaks the contract; the message lists all findings."""

    def __init__(self, message: str, findings: Sequence[Finding] = ()) -> None:
        super().__init__(message)
        self.findings = tuple(findings)


class CallError(Exception):
    """A call of the estimator failed; the message describes the call and the error."""

    def __init__(self, message: str, cause: object = None) -> None:
        super().__init__(message)
        #: Equal for calls that failed for the same reason.
        self.cause = cause or message


Check = Callable[[Factory], Iterator[str | CallError]]


def check_estimator(factory: Factory | str) -> tuple[Finding, ...]:
    """Check that an estimator runs in slamgym and computes right beliefs.

    Drives the estimator through a small known world. All findings are reported at once:
    what keeps it from running, which beliefs are wrong, and what is recommended, namely
    informative reports, refusal of malformed readings, and saved states.

    Parameters
    ----------
    factory : callable or str
        Makes the estimator from the keywords ``motion_std``, ``measurement_std``,
        ``initial_pose``, ``initial_pose_std``; usually a class. A str is a name that
        `make_estimator` accepts.

    Returns
    -------
    tuple of Finding
        The recommendations that the estimator does not follow.

    Raises
    ------
    EstimatorContractError
        If the estimator cannot run or computes wrong beliefs. The message lists all
        findings; the attribute ``findings`` holds them.
    TypeError
        If the factory is not callable, for example if it is an estimator.
    ValueError
        If there is no estimator of that name.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> check_estimator(EkfSlam)
    ()
    """
    factory = _callable(factory)
    findings = find_breaches(factory)
    if any(finding.level != "recommended" for finding in findings):
        raise EstimatorContractError(listed(factory, findings), findings)
    return findings


def find_breaches(
    factory: Factory | str,
    levels: Sequence[Level] = ("required", "correct", "recommended"),
) -> tuple[Finding, ...]:
    """Return the findings of `check_estimator` at some levels, without raising them.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> class AddsNoNoise(EkfSlam):
    ...     def predict(self, odometry, dt=1.0):
    ...         super().predict(odometry, 0.0)
    >>> finding = find_breaches(AddsNoNoise, ["correct"])[0]
    >>> finding.message.partition(": covariance")[0]
    'predict(): the motion noise is missing'
    """
    factory = _callable(factory)
    found: dict[object, Finding] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # nan that a check looks for
        for level in levels:
            for check in CHECKS[level]:
                for result in _results(check, factory):
                    cause = getattr(result, "cause", result)
                    found.setdefault(cause, Finding(level, str(result)))
    return tuple(found.values())


def _callable(factory: Factory | str) -> Factory:
    """Return the factory of a name, or the given factory."""
    if isinstance(factory, str):
        name, options = read_label(factory)
        return partial(find_estimator(name), **options)
    if not callable(factory):
        raise TypeError(
            f"factory must be callable, such as an estimator's class, got {factory!r}"
        )
    return factory


def listed(factory: Factory, findings: Sequence[Finding]) -> str:
    """Return a list of findings as text, one a line, under a heading for each level."""
    lines = []
    for level, heading in _HEADINGS.items():
        messages = [finding.message for finding in findings if finding.level == level]
        if messages:
            lines += [heading.format(_name(factory))]
            lines += [f"- {message}" for message in messages]
    if any(finding.level == "required" for finding in findings):
        lines += [_INTERFACE]
    return "\n".join(lines)


def _results(check: Check, factory: Factory) -> Iterator[str | CallError]:
    """Yield what a check finds; no exception of the estimator passes."""
    try:
        yield from check(factory)
    except CallError as error:
        yield error
    except Exception as error:
        yield (
            f"{check.__name__}() cannot use what the estimator returned: "
            f"{type(error).__name__}: {error}"
        )


class Trial:
    """An estimator in the trial world; a failed call raises a :class:`CallError`."""

    def __init__(
        self, factory: Factory, settings: Mapping[str, Sequence[float]] = START
    ) -> None:
        self.estimator = _called(_name(factory), factory, **{**NOISE, **settings})

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._call, name)

    def belief(self) -> Belief:
        """Return the belief, which must be a :class:`Belief`."""
        belief = self._call("belief")
        if not isinstance(belief, Belief):
            raise CallError(
                "belief() must return a Belief(mean, covariance, landmark_ids), got "
                f"{type(belief).__name__}"
            )
        return belief

    def drive(self, steps: int, seed: int = 0) -> Array:
        """Drive a noisy arc; return the true pose at its end."""
        rng = np.random.default_rng(seed)
        pose = np.zeros(3)
        for _ in range(steps):
            odometry = np.array([0.3, 0.1]) + rng.standard_normal(2) * (0.05, 0.02)
            pose = predict_pose(pose, odometry).pose
            self.predict((0.3, 0.1))
            self.update(scan(pose, rng), IDS)
        return pose

    def _call(self, name: str, *arguments: Any, **keywords: Any) -> Any:
        method: Any = getattr(self.estimator, name, None)
        if lacks := lack(self.estimator, name):
            try:
                inspect.signature(method).bind(*arguments, **keywords)
            except TypeError:
                raise CallError(lacks) from None
        return _called(name, method, *arguments, **keywords)


def lack(estimator: object, name: str) -> str:
    """Return how a method of an estimator, or of a class, differs from the interface.

    Examples
    --------
    >>> class Still:
    ...     def predict(self, odometry): ...
    >>> print(lack(Still(), "predict"))
    Still has predict(odometry) in place of predict(odometry, dt)
    """
    method, wanted = getattr(estimator, name, None), getattr(SlamEstimator, name)
    unbound = (None,) if isinstance(estimator, type) else ()
    kind = estimator if isinstance(estimator, type) else type(estimator)
    _self, *call = inspect.signature(wanted).parameters
    interface = f"{name}({', '.join(call)})"
    if not callable(method):
        return f"{kind.__name__} has no method {interface}"
    try:
        signature = inspect.signature(method)
    except (TypeError, ValueError):  # compiled
        return ""
    try:
        signature.bind(*unbound, *call)
    except TypeError:
        named = ", ".join(list(signature.parameters)[len(unbound) :])
        return f"{kind.__name__} has {name}({named}) in place of {interface}"
    return ""


def scan(pose: Array, rng: np.random.Generator | None = None) -> Array:
    """Read all landmarks, (n, 2), with noise when an rng is given."""
    readings = predict_measurement(pose, LANDMARKS).measurement
    if rng is not None:
        readings += rng.standard_normal(readings.shape) * NOISE["measurement_std"]
    return readings


def same_beliefs(one: Belief, other: Belief) -> bool:
    """Return whether two beliefs are equal to the bit."""
    return (
        one.landmark_ids == other.landmark_ids
        and np.array_equal(one.mean, other.mean)
        and np.array_equal(one.covariance, other.covariance)
    )


def _called(name: str, function: Callable[..., Any], *values: Any, **named: Any) -> Any:
    """Call a function of the user; describe the call if it fails."""
    try:
        return function(*values, **named)
    except Exception as error:
        shown = [_shown(value) for value in values]
        shown += [f"{key}={_shown(value)}" for key, value in named.items()]
        kind, place = type(error).__name__, _place(error)
        message = f"{name}({', '.join(shown)}) raised {kind}: {error}{place}"
        raise CallError(message, (name, kind, place or str(error))) from error


def _shown(value: Any) -> str:
    """Return an argument as code, with few digits."""
    if isinstance(value, Mapping):
        return "state"
    if isinstance(value, np.ndarray):
        empty = f"np.empty({value.shape})"
        return str(value.round(2).tolist()) if value.size else empty
    return repr(value)


def _place(error: Exception) -> str:
    """Return the line of the user's code where a call of it failed, "" if unknown."""
    frames = traceback.extract_tb(error.__traceback__)[1:]
    theirs = [frame for frame in frames if not frame.filename.startswith(_PACKAGE)]
    frames = theirs or frames[-1:]
    own = [frame for frame in frames if frame.filename == frames[0].filename]
    if not own:
        return ""
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno}: {own[-1].line})"


def _name(factory: Factory) -> str:
    """Return what a factory is called."""
    made = getattr(factory, "func", factory)  # of a partial
    return getattr(made, "__name__", None) or type(made).__name__


def check_interface(factory: Factory) -> Iterator[str | CallError]:
    """Check that the methods of every run exist and accept their arguments."""
    made = getattr(factory, "func", factory)
    try:
        made = Trial(factory).estimator
    except CallError as error:
        yield error
        if not isinstance(made, type):
            return
    yield from filter(None, (lack(made, name) for name in _NEEDED))


def check_calls(factory: Factory) -> Iterator[str | CallError]:
    """Check that all calls of a run succeed, each whether or not another one does."""
    trial = Trial(factory)
    for call in (
        partial(trial.predict, np.array([0.3, 0.1]), 1.0),
        partial(trial.update, scan(np.zeros(3)), IDS),
        partial(trial.update, scan(np.zeros(3)), IDS),
        partial(trial.update, np.empty((0, 2)), []),
        trial.belief,
        partial(trial.reset, np.zeros(3), np.zeros(3)),
    ):
        try:
            call()
        except CallError as error:
            yield error


def check_reports(factory: Factory) -> Iterator[str]:
    """Check that updates return reports with numbers and ids."""
    trial = Trial(factory)
    for _ in range(2):
        report = trial.update(scan(np.zeros(3)), IDS)
        if not isinstance(report, UpdateReport):
            yield (
                f"update() must return an UpdateReport, got {type(report).__name__}; "
                "UpdateReport() will do if the estimator computes no NIS"
            )
            return
        numbers = {"nis": float, "degrees_of_freedom": int}
        for name, kind in numbers.items():
            number = getattr(report, name)
            if np.ndim(number) or not np.isfinite(number) or kind(number) != number:
                yield f"update().{name} must be a finite {kind.__name__}, got {number}"
        for name in ("associated_ids", "added_ids", "rejected_ids", "skipped_ids"):
            ids = getattr(report, name)
            if not isinstance(ids, Sequence) or not set(ids) <= set(IDS):
                yield f"update().{name} must be a tuple of given ids, got {ids!r}"


def check_beliefs(factory: Factory) -> Iterator[str]:
    """Check that beliefs are finite and about the landmarks given to updates."""
    trial = Trial(factory)
    trial.update(scan(np.zeros(3))[[2, 0]], [9, 4])
    trial.predict((0.3, 0.1), 1.0)
    belief = trial.belief()
    ids = belief.landmark_ids
    if not set(ids) <= {9, 4}:  # a belief refuses ids that repeat
        yield (
            "belief().landmark_ids must be the different ids given to update(), "
            f"here 9 and 4, got {ids}"
        )
    if not (np.isfinite(belief.mean).all() and np.isfinite(belief.covariance).all()):
        yield (
            "belief() must be finite, got the mean "
            f"{belief.mean.tolist()} and the variances "
            f"{belief.covariance.diagonal().tolist()}"
        )


def check_snapshots(factory: Factory) -> Iterator[str]:
    """Check that a belief does not change in later steps."""
    trial = Trial(factory)
    trial.drive(steps=2)
    kept = trial.belief()
    mean, covariance = kept.mean.copy(), kept.covariance.copy()
    trial.predict((1.0, 0.2))
    trial.update(scan(np.array([1.0, 0.0, 0.3])), IDS)
    trial.belief()
    if not (np.array_equal(mean, kept.mean) and (covariance == kept.covariance).all()):
        yield "belief() must return a snapshot: a kept belief changed in later steps"


def check_start(factory: Factory) -> Iterator[str]:
    """Check the belief of a new estimator."""
    pose, std = (1.0, -2.0, 0.5), (0.1, 0.2, 0.3)
    belief = Trial(factory, {"initial_pose": pose, "initial_pose_std": std}).belief()
    yield from _start_findings("a new estimator", belief, pose, std)


def check_reset(factory: Factory) -> Iterator[str]:
    """Check that a reset estimator starts again."""
    pose, std = (1.0, 2.0, 0.3), (0.0, 0.1, 0.2)
    trial = Trial(factory)
    trial.drive(steps=5)
    trial.reset(pose, std)
    yield from _start_findings("reset(pose, pose_std)", trial.belief(), pose, std)


def _start_findings(
    whose: str, belief: Belief, pose: Sequence[float], std: Sequence[float]
) -> Iterator[str]:
    wanted = np.diag(np.square(std))
    if not np.allclose(belief.pose, pose):
        found = belief.pose.round(6).tolist()
        yield f"belief().pose after {whose} must be the pose {pose}, got {found}"
    if belief.landmark_ids:
        found = belief.landmark_ids
        yield f"belief() after {whose} must have no landmarks, got {found}"
    if not np.allclose(belief.pose_covariance, wanted):
        yield (
            f"belief().pose_covariance after {whose} must be diag(pose_std²), "
            f"{wanted.round(6).tolist()}, got {belief.pose_covariance.tolist()}"
        )


def check_motion(factory: Factory) -> Iterator[str]:
    """Check the motion model."""
    trial = Trial(factory, START | {"initial_pose": (0.0, 0.0, np.pi / 2)})
    trial.predict((2.0, 0.5))
    pose = trial.belief().pose
    if not np.allclose(pose, (0, 2, np.pi / 2 + 0.5), atol=1e-6):
        yield (
            "predict((d, α)) must drive d along the old heading, then turn by α: from "
            f"(0, 0, π/2), (2, 0.5) leads to (0, 2, π/2 + 0.5), got "
            f"{pose.round(6).tolist()}"
        )


def check_steps(factory: Factory) -> Iterator[str]:
    """Check how each call moves mean and covariance; name the mistake if it is known.

    The checks of single models run only for methods without a named mistake, because
    they describe the same deviation in general words.
    """
    made = partial(Trial, factory)
    named = set()
    for mistake in step_mistakes(made):  # one by one: it may end with an exception
        yield str(mistake)
        if mistake.cause:
            named.add(mistake.method)
    for method, check in (
        ("predict()", check_motion),
        ("update() of new landmarks", check_mapping),
        ("update()", check_second_reading),
    ):
        if method not in named:
            yield from check(factory)
    if not named:
        yield from check_update(factory)


def check_mapping(factory: Factory) -> Iterator[str]:
    """Check how landmarks enter the map."""
    trial = Trial(factory)
    trial.update(scan(np.zeros(3))[[2, 0]], [9, 4])
    belief = trial.belief()
    if set(belief.landmark_ids) != {9, 4}:
        yield f"update() of ids 9 and 4 must map them, got {belief.landmark_ids}"
        return
    order = [belief.landmark_ids.index(9), belief.landmark_ids.index(4)]
    if not np.allclose(belief.landmarks[order], LANDMARKS[[2, 0]], atol=1e-3):
        yield (
            "a landmark read exactly from a known pose must be mapped where it is: l = "
            f"(x + r cos(θ + β), y + r sin(θ + β)) = {LANDMARKS[[2, 0]].tolist()}, got "
            f"{belief.landmarks[order].round(6).tolist()}"
        )


def check_covariances(factory: Factory) -> Iterator[str]:
    """Check that covariances are symmetric and semidefinite, up to rounding."""
    trial = Trial(factory)
    trial.drive(steps=20)
    P = trial.belief().covariance
    rounding = 1e-9 * max(1.0, np.abs(P).max())
    if not np.allclose(P, P.T, rtol=0, atol=rounding):
        yield (
            "belief().covariance must be symmetric, got elements that differ by "
            f"{np.abs(P - P.T).max():.2g}"
        )
    if not (least := np.linalg.eigvalsh(P).min()) > -rounding:
        yield (
            "belief().covariance must be positive semidefinite, got the eigenvalue "
            f"{least:.2g}"
        )


def check_update(factory: Factory) -> Iterator[str]:
    """Check that updates fit the truth, and make the belief more certain."""
    trial = Trial(factory)
    pose = trial.drive(steps=20)
    belief = trial.belief()
    error = belief.pose - pose
    error[2] = wrap_angle(error[2])
    nees = float(error @ np.linalg.solve(belief.pose_covariance, error))
    if not nees < 30:
        yield (
            "after 20 easy steps the error of the pose must fit its covariance: NEES "
            f"below 30 (3 is expected), got {nees:.1f}"
        )
    trial.update(scan(pose), IDS)
    if not np.trace(trial.belief().covariance) <= np.trace(belief.covariance) + 1e-12:
        yield "update() must not make the belief less certain"


def check_second_reading(factory: Factory) -> Iterator[str]:
    """Read a landmark behind the robot from both sides of the jump of the bearing."""
    for bearing in (3.13, -3.13):
        trial = Trial(factory)
        trial.update([(bearing, 3.0)], [0])
        variance = np.trace(trial.belief().covariance)
        nis = getattr(trial.update([(-bearing, 3.0)], [0]), "nis", 0.0)
        belief = trial.belief()
        error = float(np.linalg.norm(belief.landmarks - (-3.0, 0.0)))
        if not (nis < 10 and error < 0.1):
            yield (
                f"bearings {bearing} and {-bearing} rad are next to each other: "
                "update() must wrap the innovation to [-π, π), got NIS "
                f"{nis:.2g} and a landmark {error:.2g} m off"
            )
        elif not np.trace(belief.covariance) < variance:
            yield (
                "update() must make the belief more certain: a second reading of a "
                "landmark must shrink its covariance"
            )


def check_empty_scan(factory: Factory, ids: Sequence[int] | None = ()) -> Iterator[str]:
    """Check that a scan without readings changes nothing."""
    trial = Trial(factory)
    trial.drive(steps=2)
    before = trial.belief()
    report = trial.update(np.empty((0, 2)), ids)
    unused = getattr(report, "degrees_of_freedom", 0) == 0
    if not (same_beliefs(before, trial.belief()) and unused):
        yield f"update() with no reading (ids {ids}) must leave the belief as it was"


def check_scans_without_ids(factory: Factory) -> Iterator[str]:
    """Check the same where a log has no ids."""
    return check_empty_scan(factory, None)


def check_default_start(factory: Factory) -> Iterator[str]:
    """Check that an estimator starts at the origin where no initial pose is given."""
    belief = Trial(factory, {}).belief()
    if not np.allclose(belief.pose, 0.0):
        yield f"initial_pose should be the origin by default, got {belief.pose}"


def check_report_contents(factory: Factory) -> Iterator[str]:
    """Check that reports fit the scans."""
    trial = Trial(factory)
    added = trial.update(scan(np.zeros(3)), IDS)
    report = trial.update(scan(np.zeros(3)), IDS)
    if not (isinstance(report, UpdateReport) and isinstance(added, UpdateReport)):
        return
    if set(added.added_ids) != set(IDS):
        yield f"update() should report new landmarks in added_ids, got {added!r}"
    if report.degrees_of_freedom != 8 or set(report.associated_ids) != set(IDS):
        yield (
            "update() should report the 4 readings used: associated_ids (0, 1, 2, 3) "
            f"and 8 degrees_of_freedom, got {report.associated_ids} and "
            f"{report.degrees_of_freedom}; tests of the NIS need both"
        )
    elif not 0 <= report.nis < 60:
        yield f"update().nis must be νᵀ S⁻¹ ν of plausible readings, got {report.nis}"


def check_refusals(factory: Factory) -> Iterator[str]:
    """Check that malformed arguments raise a ValueError and change nothing."""
    readings = scan(np.zeros(3))
    calls: dict[str, tuple[Any, ...]] = {
        "predict((nan, 0))": ("predict", (np.nan, 0.0)),
        "update() with a NaN": ("update", [(np.nan, 1.0)], [0]),
        "update() with an infinite range": ("update", [(0, 2), (0, np.inf)], [0, 1]),
        "update() with an id twice": ("update", readings, [0] * 4),
        "update() with 4 readings and 1 id": ("update", readings, [0]),
    }
    answers = {name: _answer(factory, *call) for name, call in calls.items()}
    wrong = [f"{name} {answer}" for name, answer in answers.items() if answer]
    if wrong:
        yield (
            "malformed arguments should raise a ValueError and leave the belief as it "
            f"was, but {', '.join(wrong)}"
        )


def _answer(factory: Factory, method: str, *arguments: Any) -> str:
    """Return how a call with malformed arguments goes wrong, "" if it is refused."""
    trial = Trial(factory)
    trial.drive(steps=2)
    before = trial.belief()
    try:
        getattr(trial, method)(*arguments)
    except CallError as error:
        if not isinstance(cause := error.__cause__, ValueError):
            return f"raised {type(cause).__name__}: {cause}"
        return "" if same_beliefs(before, trial.belief()) else "changed the belief"
    return "raised nothing"


def check_saving(factory: Factory) -> Iterator[str]:
    """Check that an estimator can be saved and restored."""
    trial = Trial(factory)
    yield from filter(None, (lack(trial.estimator, name) for name in _SAVING))


def check_save_and_restore(factory: Factory) -> Iterator[str]:
    """Check that a saved state continues bit for bit, also from a file of arrays."""
    trial, other = Trial(factory), Trial(factory)
    trial.drive(steps=5)
    state, file = trial.state_dict(), BytesIO()
    try:
        np.savez(file, **state)
        file.seek(0)
        with np.load(file) as saved:
            state = dict(saved)
    except Exception as error:
        yield (
            "state_dict() must return what numpy.savez saves and loads, got "
            f"{type(error).__name__}: {error}"
        )
        return
    other.load_state_dict(state)
    if not _same_later(trial, other):
        yield (
            "load_state_dict(state_dict()) must restore the estimator bit for bit: "
            "the beliefs differ, then or after three steps"
        )


def check_saved_state_is_a_copy(factory: Factory) -> Iterator[str]:
    """Check that a saved state shares no memory with the estimator."""
    trial, other = Trial(factory), Trial(factory)
    for each in (trial, other):
        each.drive(steps=5)
    _overwrite(trial.state_dict())
    if not _same_later(trial, other):
        yield (
            "state_dict() must return copies: writing into what it returned changed "
            "the estimator"
        )
        return
    state = other.state_dict()
    trial.load_state_dict(state)
    _overwrite(state)
    if not _same_later(trial, other):
        yield (
            "load_state_dict() must copy: writing into what it was given changed the "
            "estimator"
        )


def _overwrite(state: Mapping[str, Any]) -> None:
    """Spoil every number in the arrays of a saved state."""
    for value in state.values():
        numbers = isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
        if numbers and value.flags.writeable:
            value[...] = 77


def _same_later(one: Trial, other: Trial) -> bool:
    """Whether two estimators agree now, and after the same three steps."""
    if not same_beliefs(one.belief(), other.belief()):
        return False
    for each in (one, other):
        each.drive(steps=3, seed=1)
    return same_beliefs(one.belief(), other.belief())


def check_repeated_runs(factory: Factory) -> Iterator[str]:
    """Check that a run after a reset equals that of a new estimator."""
    trial = Trial(factory)
    trial.drive(steps=5)
    trial.reset((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    if not _same_later(trial, Trial(factory)):
        yield "reset() should forget the run, but the next one differs from a first one"


#: The checks of each level, in the order of their findings.
CHECKS: dict[Level, tuple[Check, ...]] = {
    "required": (
        check_interface,
        check_calls,
        check_reports,
        check_beliefs,
        check_snapshots,
    ),
    "correct": (
        check_start,
        check_steps,
        check_covariances,
        check_empty_scan,
        check_reset,
    ),
    "recommended": (
        check_default_start,
        check_report_contents,
        check_scans_without_ids,
        check_refusals,
        check_saving,
        check_save_and_restore,
        check_saved_state_is_a_copy,
        check_repeated_runs,
    ),
}
