"""Make estimators by name, also those that users register: `make_estimator`.

A label names a filter and its options, as "invariant[iterations=3]".
"""

from __future__ import annotations

import inspect
import re
import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from numpy.typing import ArrayLike

from ..leaves import leaf
from ..public_names import is_here
from ..suggestions import closest, imported
from .filters import ekf
from .models.sensors import NUMBERS, sensor_in

if TYPE_CHECKING:
    from .filters.batch import BatchSlam
    from .interface import SlamEstimator
    from .map_management.policy import LandmarkPolicy


EstimatorFactory: TypeAlias = "Callable[..., SlamEstimator]"
_NOISE = ("motion_std", "measurement_std", "initial_pose", "initial_pose_std")
_OTHERS = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
_REFUSED = re.compile(r"(?:unexpected keyword argument|no option) '(\w+)'")

_factories: dict[str, EstimatorFactory | str] = {}  # or where to import it from

_catalogue = leaf("estimator.peers.catalogue")
#: The estimators of other libraries, by name.
PEERS: Mapping[str, Any] = _catalogue.PEERS if _catalogue else {}


class UnknownOptionError(ValueError, TypeError):
    """Raised for an option that an estimator does not have.

    It is also a `TypeError`, which Python raises for an unknown keyword.
    """


def register_estimator(name: str, factory: EstimatorFactory) -> None:
    """Make an estimator available to :func:`make_estimator` and the command line.

    Parameters
    ----------
    name : str
        Name to call it by, without the brackets and commas of labels; an earlier
        estimator of that name is replaced.
    factory : callable
        Called with ``motion_std``, ``measurement_std``, ``initial_pose``,
        ``initial_pose_std`` and options as keywords; returns the estimator.  Its
        docstring's first line is shown in lists.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> register_estimator("mine", EkfSlam)
    >>> "mine" in list_estimators()
    True
    >>> del _factories["mine"]
    """
    if not callable(factory):
        raise TypeError(f"factory must be callable, got {factory!r}")
    label = _LABEL.fullmatch(name) if isinstance(name, str) else None
    if label is None or label["name"].strip() != name:
        raise ValueError(
            "name must be a text without brackets, commas and outer spaces, "
            f"got {name!r}"
        )
    _factories[name] = factory


def list_estimators() -> tuple[str, ...]:
    """Return the registered names, in the order of registration.

    Those of other libraries, which :func:`~slamgym.estimator.list_peers` returns, are
    not among them.
    """
    return tuple(name for name in _factories if name not in PEERS)


def is_registered(name: str) -> bool:
    """Return whether a name is registered, of slamgym, of a peer or of a user."""
    return name in _factories


def find_estimator(name: str) -> EstimatorFactory:
    """Return the factory of a registered name or of an import path "module:Class".

    Raises
    ------
    ValueError
        If there is none, with the nearest name, or where its library is not
        installed, with how to install it.
    """
    factory = _factories.get(name, name)
    if name in PEERS and isinstance(factory, str):
        PEERS[name].refuse_missing()
    if not isinstance(factory, str):
        return factory
    if ":" in factory:
        made: EstimatorFactory = imported(
            factory, f"cannot import estimator '{factory}', ", kind=True
        )
        return made
    hint, known = closest(name, _factories), ", ".join(_factories)
    raise ValueError(f"unknown estimator '{name}'{hint} (there are {known})")


def make_estimator(
    name: str,
    *,
    motion_std: ArrayLike,
    measurement_std: ArrayLike,
    initial_pose: ArrayLike = (0.0, 0.0, 0.0),
    initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
    management: LandmarkPolicy | Mapping[str, Any] | bool | None = None,
    **options: Any,
) -> SlamEstimator:
    """Make an estimator by its registered name or by its import path.

    Parameters
    ----------
    name : str
        One of :func:`list_estimators` or of
        :func:`~slamgym.estimator.list_peers`, or "module:Class"; with or without
        options in brackets, which override those given as keywords.
    motion_std : array_like, shape (3,)
        (σx, σy, σα) of the motion noise in the robot frame [m, m, rad] per step.
    measurement_std : array_like, shape (2,)
        (σβ, σr) of the measurement noise [rad, m].
    initial_pose, initial_pose_std : array_like, shape (3,)
        Mean and standard deviation of the first pose (x, y, θ) [m, m, rad].
    management : LandmarkPolicy, mapping or True, optional
        How to associate readings without identity, and which landmarks to confirm, to
        remove, to merge.
    **options
        What the estimator's own constructor takes beside these; where it takes
        ``sensor``, also the numbers of its noise, such as ``range_std_per_metre``.

    Raises
    ------
    ValueError
        If the name is unknown or an argument is refused.
    UnknownOptionError
        A ValueError and TypeError, where the estimator does not have an option; it
        suggests the nearest one.

    Examples
    --------
    >>> slam = make_estimator(
    ...     "invariant[iterations=3]",
    ...     motion_std=(0.1, 0.1, 0.05),
    ...     measurement_std=(0.02, 0.1),
    ... )
    >>> slam.belief().pose
    array([0., 0., 0.])
    """
    name, own = read_label(name)
    options |= own
    management = options.pop("management", management)
    own_factory = factory = find_estimator(name)
    options = with_sensor(factory, options)
    if management is not None and management is not False:
        from .map_management import ManagedSlam  # noqa: PLC0415 (heavy)

        factory = partial(ManagedSlam, factory, management=management)
    try:
        return factory(
            motion_std=motion_std,
            measurement_std=measurement_std,
            initial_pose=initial_pose,
            initial_pose_std=initial_pose_std,
            **options,
        )
    except TypeError as error:
        message = _unknown_option(error, name, own_factory, options)
        if message is None:
            raise
        raise UnknownOptionError(message) from error


def with_sensor(
    factory: EstimatorFactory, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return options with the numbers of the sensor's noise as part of the sensor."""
    names, passes_others = _keywords(factory)
    numbers = {name for name in NUMBERS if name in options and name not in names}
    if not (numbers and ("sensor" in names or passes_others)):
        return dict(options)
    others = {name: value for name, value in options.items() if name not in numbers}
    read = {name: options[name] for name in ("sensor", *numbers) if name in options}
    return others | {"sensor": sensor_in(read)}


def make_batch(
    name: str,
    *,
    runs: int,
    landmarks: int,
    motion_std: ArrayLike,
    measurement_std: ArrayLike,
    initial_poses: ArrayLike = (0.0, 0.0, 0.0),
    initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
    threads: int | None = None,
    **options: Any,
) -> BatchSlam:
    """Make a batch of runs of a registered filter.

    Parameters
    ----------
    name : str
        One of :func:`list_estimators`, with or without options in brackets.
    runs, landmarks, initial_poses, initial_pose_std, threads
        As in :class:`BatchSlam`.
    motion_std, measurement_std, **options
        As in :func:`make_estimator`.

    Raises
    ------
    ValueError
        If the filter is unknown or cannot run in batches.
    """
    if "initial_pose" in options:
        raise ValueError(
            "initial_pose must be given as initial_poses, one for each run"
        )
    estimator = make_estimator(
        name, motion_std=motion_std, measurement_std=measurement_std, **options
    )
    from .filters.batch import BatchSlam  # noqa: PLC0415 (one filter does without)

    if not isinstance(estimator, ekf.EkfSlam):
        managed = " with landmark management" if "management" in options else ""
        raise ValueError(f"{name}{managed} cannot run in batches")
    return BatchSlam(
        estimator,
        runs,
        landmarks,
        initial_poses=initial_poses,
        initial_pose_std=initial_pose_std,
        threads=threads,
    )


def _unknown_option(
    error: TypeError, name: str, factory: EstimatorFactory, options: Mapping[str, Any]
) -> str | None:
    """Return the message for an unknown option, or None if the error is another."""
    refused = _REFUSED.search(str(error))
    if refused is None or refused[1] not in options:
        return None
    known = [option for option in _known_options(factory) if option != refused[1]]
    hint = closest(refused[1], known)
    listed = f" (there are {', '.join(known)})" if known else ""
    name = name.rpartition(":")[2]
    return f"{name} has no option '{refused[1]}'{hint}{listed}"


def _known_options(factory: EstimatorFactory) -> list[str]:
    """Return the options of a factory, and of the classes that get its others."""
    makers = [factory]
    if isinstance(factory, type):  # the base filter of a large map is an `EkfSlam`
        own = [kind for kind in factory.__mro__[:-1] if "__init__" in vars(kind)]
        makers = [*own, ekf.EkfSlam]
    known: list[str] = []
    for maker in makers:
        names, passes_others = _keywords(maker)
        names += NUMBERS if "sensor" in names else ()
        known += [name for name in names if name not in (*_NOISE, *known)]
        if not passes_others:
            break
    return known


def _keywords(factory: Callable[..., Any]) -> tuple[list[str], bool]:
    """Return the keywords that a signature names, and whether it takes any other."""
    kinds = {p.name: p.kind for p in inspect.signature(factory).parameters.values()}
    names = [name for name, kind in kinds.items() if kind not in _OTHERS]
    return names, _OTHERS[1] in kinds.values()


def accepted_options(
    factory: EstimatorFactory, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return those options that `make_estimator` accepts for a factory.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> accepted_options(EkfSlam, {"min_range": 0.1, "colour": "red"})
    {'min_range': 0.1}
    """
    names, passes_others = _keywords(factory)
    names += NUMBERS if "sensor" in names else ()
    return {k: v for k, v in options.items() if passes_others or k in names}


def _inside(path: str) -> str:
    """Return the module of an import path, by its name in the package."""
    return path.partition(":")[0].partition(".")[2]


_LARGE = f"{__package__}.large_maps"

_shipped: dict[str, EstimatorFactory | str] = {
    "ekf": ekf.EkfSlam,
    "invariant": ekf.InvariantEkfSlam,
    "first_estimates": ekf.FirstEstimatesEkfSlam,
    "observability_constrained": ekf.ObservabilityConstrainedEkfSlam,
    "iterated": ekf.IteratedEkfSlam,
    "unscented": f"{__package__}.filters.unscented:UnscentedSlam",
    "robocentric": f"{__package__}.filters.robocentric:RobocentricEkfSlam",
    "ideal": f"{__package__}.filters.ideal:IdealEkfSlam",
    "compressed": f"{_LARGE}.compressed.compressed_slam:CompressedEkfSlam",
    "sparse_information": (
        f"{_LARGE}.sparse_information.sparse_information_slam:SparseInformationSlam"
    ),
    "submaps": f"{_LARGE}.submaps.submap_slam:SubmapSlam",
}
_factories |= {
    name: factory
    for name, factory in _shipped.items()
    if not isinstance(factory, str) or is_here(_inside(factory))
}
_factories |= {name: peer.path for name, peer in PEERS.items()}


_LABEL = re.compile(r"(?P<name>[^\[\],]+)(\[(?P<options>.*)\])?", re.DOTALL)
_BARE_WORD = re.compile(r"(=\s*)(?!true\b|false\b|inf\b|nan\b)([A-Za-z_][\w-]*)")


class FilterLabel(NamedTuple):
    """A filter and its options."""

    name: str  # registered name or "module:Class"
    options: dict[str, Any]  # arguments of its constructor other than the noise


def accepted_models(
    factory: EstimatorFactory, models: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what an estimator accepts of the models of a world or log.

    Raises
    ------
    ValueError
        If the estimator does not take the ``sensor``, ``motion`` or noise among them.
    """
    accepted = accepted_options(factory, models)
    for name in sorted(models.keys() - accepted.keys() - {"noise_at_rest"}):
        raise ValueError(f"the estimator does not accept {name} = '{models[name]}'")
    return accepted


def read_label(label: str) -> FilterLabel:
    """Read one filter: a name, and perhaps options as in TOML in brackets.

    A bare word is a string.

    Raises
    ------
    ValueError
        If the text is malformed or names several filters.

    Examples
    --------
    >>> read_label("invariant[iterations=3, landmark_init=full]")
    FilterLabel(name='invariant', options={'iterations': 3, 'landmark_init': 'full'})
    """
    match = _LABEL.fullmatch(label.strip()) if isinstance(label, str) else None
    if match is None:
        raise ValueError(
            "an estimator must be like ekf or invariant[iterations=3] or module:Class, "
            f"got '{label}'"
        )
    options = _BARE_WORD.sub(r'\1"\2"', match["options"] or "")
    try:
        table = tomllib.loads(f"options = {{ {options} }}")["options"]
    except (tomllib.TOMLDecodeError, RecursionError):
        raise ValueError(
            f"options must be like [iterations=3,min_range=0.5], got '{label}'"
        ) from None
    return FilterLabel(match["name"].strip(), table)


def split_labels(labels: str) -> list[str]:
    """Split a text at its commas outside brackets; empty parts are left out.

    Examples
    --------
    >>> split_labels("ekf, invariant[iterations=3,min_range=0.5]")
    ['ekf', 'invariant[iterations=3,min_range=0.5]']
    """
    parts, depth = [""], 0
    for character in labels:
        depth += {"[": 1, "]": -1}.get(character, 0)
        if character == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]
