"""Whether `diagnose` names errors in the code of a filter: faults and answers.

    python benchmarks/causes_of_faults.py

Each of 23 faults, of a filter or of its readings, is tried in three worlds where the
filter without the fault is consistent, and 20 studies have none. An answer is right if
it names the kind of the fault, or if the fault changes so little that the verdict is
"consistent" or "nearly consistent"; "cannot tell" is counted by itself. `--later` tries
20 other faults in three other worlds, unknown when the rules were developed. `--map`
reports wrong maps beside correct poses in two worlds, and counts the refused studies,
also among 20 without a fault. `--seed` gives other random numbers.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from slamgym import Belief
from slamgym.estimator import EkfSlam, InvariantEkfSlam, UpdateReport
from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.experiments.monte_carlo_study import (
    monte_carlo,
    runner,
    summarise_monte_carlo,
)
from slamgym.sim_configs import Scenario, load_scenario

Array = NDArray[np.float64]
TEXTBOOK = Path(__file__).parents[1] / "examples" / "05_your_own_estimator.py"
MODEL, COVARIANCE, CANNOT_TELL = "wrong model", "wrong covariance", "cannot tell"
#: A fault of the covariances that only the map shows.
WRONG_COVARIANCES_OF_MAPS = "map: scale: ", "map: covariances between "


def mirrored(runs: Any) -> Any:
    """Return runs whose bearings have the wrong sign."""
    return runs._replace(measurements=runs.measurements * [-1, 1])


def late(runs: Any) -> Any:
    """Return runs whose scans come one step late."""
    visible = np.roll(runs.visible, 1, axis=1)
    visible[:, 0] = False
    return runs._replace(
        measurements=np.roll(runs.measurements, 1, axis=1), visible=visible
    )


def behind(runs: Any) -> Any:
    """Return runs whose sensor is .3 m behind the robot."""
    bearings, ranges = np.moveaxis(runs.measurements, -1, 0)
    x, y = ranges * np.cos(bearings) + 0.3, ranges * np.sin(bearings)
    return runs._replace(
        measurements=np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=-1)
    )


def biased(runs: Any) -> Any:
    """Return runs whose bearings are .006 rad too large."""
    return runs._replace(measurements=runs.measurements + np.array([0.006, 0]))


def long(runs: Any) -> Any:
    """Return runs whose ranges are 2 % too long."""
    return runs._replace(measurements=runs.measurements * [1, 1.02])


def clipped(runs: Any) -> Any:
    """Return runs whose ranges above 4 m are 4 m."""
    return runs._replace(measurements=np.minimum(runs.measurements, [np.inf, 4.0]))


def swapped(runs: Any) -> Any:
    """Return runs whose landmarks 0 and 1 have each other's identity from scan 10."""
    measurements, visible = runs.measurements.copy(), runs.visible.copy()
    for array in (measurements, visible):
        array[:, 10:, :2] = array[:, 10:, 1::-1]
    return runs._replace(measurements=measurements, visible=visible)


def scaled(runs: Any) -> Any:
    """Return runs whose odometry reads distances 3 % too long."""
    return runs._replace(odometry=runs.odometry * [1.03, 1])


def late_odometry(runs: Any) -> Any:
    """Return runs whose odometry comes one step late."""
    odometry = np.roll(runs.odometry, 1, axis=1)
    odometry[:, 0] = 0.0
    return runs._replace(odometry=odometry)


class TurnsFirst(EkfSlam):
    """Turns before it drives."""

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Turn, then drive."""
        distance, turn = odometry
        super().predict((0.0, turn), 0.0)
        super().predict((distance, 0.0), dt)


class UsesTwice(EkfSlam):
    """Every scan is used twice."""

    def update(self, measurements: Any, landmark_ids: Any = None) -> UpdateReport:
        """Take in the scan twice."""
        super().update(measurements, landmark_ids)
        return super().update(measurements, landmark_ids)


class HalfDt(EkfSlam):
    """Motion noise counts half."""

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Move with half of the noise."""
        super().predict(odometry, dt / 2)


class CertainStart(EkfSlam):
    """The deviations of the first pose are a fifth of what they should be."""

    def __init__(self, **settings: Any) -> None:
        std = np.array(settings.pop("initial_pose_std", (0.0, 0.0, 0.0))) / 5
        super().__init__(initial_pose_std=std, **settings)

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Move as usual, but not in a batch, which has a start of its own."""
        super().predict(odometry, dt)


def textbook(old: str, new: str) -> type:
    """Return the filter of the example, with a text of it in place of another."""
    source, module = TEXTBOOK.read_text(encoding="utf-8"), ModuleType("textbook")
    assert source.count(old) == 1, old
    exec(compile(source.replace(old, new), str(TEXTBOOK), "exec"), module.__dict__)
    return type("TextbookEkf", (module.TextbookEkf,), {"__module__": __name__})


class Fault(NamedTuple):
    """A fault and the answers that are right."""

    name: str
    right: tuple[str, ...]
    estimator: Any = "ekf"
    input: Callable[[Any], Any] = lambda runs: runs
    """Change of what the filter reads, by which the world is as before."""
    world: Callable[[Scenario, Any], Any] = lambda _, runs: runs
    """Change of the readings of the world."""


def correlated(world: Scenario, runs: Any) -> Any:
    """Return runs whose bearing noise is AR(1) with φ = .9."""
    noise = autoregressive(runs.visible.shape, phi=0.9, seed=5)
    return with_noise(runs, 0, world.sensor.std[0] * noise)


def autoregressive(shape: tuple[int, ...], phi: float, seed: int) -> Array:
    """Return AR(1) noise of variance 1 over the second axis."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    for step in range(1, noise.shape[1]):
        fresh = np.sqrt(1 - phi**2) * noise[:, step]
        noise[:, step] = phi * noise[:, step - 1] + fresh
    return noise


def with_outliers(world: Scenario, runs: Any) -> Any:
    """Return runs where 2 % of the ranges err by ten deviations."""
    rng = np.random.default_rng(6)
    size = np.where(rng.random(runs.visible.shape) < 0.02, 10.0, 1.0)
    noise = size * rng.standard_normal(runs.visible.shape)
    return with_noise(runs, 1, world.sensor.std[1] * noise)


def with_noise(runs: Any, column: int, noise: Array | float) -> Any:
    """Replace the noise of all bearings (0) or ranges (1)."""
    measurements = runs.measurements.copy()
    for run, poses in enumerate(runs.true_poses):
        for step, pose in enumerate(poses):
            exact = predict_measurement(pose, runs.landmarks_of_rows[run]).measurement
            measurements[run, step, :, column] = exact[:, column]
    measurements[..., column] += noise
    return runs._replace(measurements=measurements)


FAULTS = (
    Fault("bearing mirrored in the filter", (MODEL,), input=mirrored),
    Fault("scan one step late", (MODEL,), input=late),
    Fault("sensor .3 m off", (MODEL,), input=behind),
    Fault(
        "sign error in G",
        (COVARIANCE,),
        textbook("G[:2, 2] = -d * s, d * c", "G[:2, 2] = d * s, -d * c"),
    ),
    Fault("bias .006 rad in the filter", (MODEL,), input=biased),
    Fault(
        "new landmarks independent",
        (COVARIANCE,),
        ("ekf", {"landmark_init": "independent"}),
    ),
    Fault("bearing error AR(1), φ = .9", ("correlated noise",), world=correlated),
    Fault("half dt", (COVARIANCE,), HalfDt),
    Fault("scaled odometry in the filter", (MODEL,), input=scaled),
    Fault("2 % outliers", ("heavy tails",), world=with_outliers),
    Fault("first deviations / 5", (COVARIANCE,), CertainStart),
    Fault("clipped range", (MODEL,), input=clipped),
    Fault("turns first", (MODEL,), TurnsFirst),
    Fault("scan used twice", (COVARIANCE,), UsesTwice),
    Fault("no wrap", (MODEL,), textbook("nu[::2] = wrap_angle(nu[::2])", "")),
    Fault(
        "covariance of the pose and the map not moved",
        (COVARIANCE,),
        textbook(
            "self.P = G @ self.P @ G.T + F @ self.R @ F.T * dt",
            "A, B = G[:3, :3], F[:3]\n        "
            "self.P[:3, :3] = A @ self.P[:3, :3] @ A.T + B @ self.R @ B.T * dt",
        ),
    ),
    Fault("ranges 2 % too long", (MODEL,), input=long),
    Fault(
        "deviations of bearing and range halved",
        (COVARIANCE,),
        textbook("np.square(measurement_std)", "np.square(measurement_std) / 4"),
    ),
    Fault(
        "motion noise not rotated",
        (COVARIANCE,),
        textbook("F[:2, :2] = (c, -s), (s, c)", ""),
    ),
    Fault("odometry one step late", (MODEL,), input=late_odometry),
    Fault(
        "no heading in H", (COVARIANCE,), textbook("-dx / r**2, -1)", "-dx / r**2, 0)")
    ),
    Fault("two identities swapped", (MODEL,), input=swapped),
    Fault(
        "new landmark without the noise of its range",
        (COVARIANCE,),
        textbook(
            "B[-2:] = (-r * s, c), (r * c, s)", "B[-2:] = (-r * s, 0), (r * c, 0)"
        ),
    ),
)
GAIN = "self.x, self.P = self.x + K @ nu, self.P - K @ S @ K.T"


class DriftsInHeading(EkfSlam):
    """Turns by .002 rad too much in each step."""

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Move with a turn that is too large."""
        distance, turn = odometry
        super().predict((distance, turn + 0.002), dt)


class ForgetsNoiseInTurns(EkfSlam):
    """Adds no motion noise while it turns."""

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Move without noise in a turn."""
        super().predict(odometry, dt if abs(odometry[1]) < 0.05 else 0.0)


class AddsNoiseEveryOtherStep(EkfSlam):
    """Adds motion noise in every other step only."""

    def __init__(self, **settings: Any) -> None:
        self.count = 0
        super().__init__(**settings)

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Move, with noise in odd steps."""
        self.count += 1
        super().predict(odometry, dt * (self.count % 2))


class SquaresDt(EkfSlam):
    """Multiplies the variance of the motion noise by 2 dt², as a derivative would."""

    def predict(self, odometry: Any, dt: float = 1.0) -> None:
        """Move with too much noise."""
        super().predict(odometry, 2 * dt**2)


def repeated(runs: Any) -> Any:
    """Return runs in which every fifth scan repeats that of the step before."""
    measurements, visible = runs.measurements.copy(), runs.visible.copy()
    for array in (measurements, visible):
        array[:, 5::5] = array[:, 4:-1:5][:, : array[:, 5::5].shape[1]]
    return runs._replace(measurements=measurements, visible=visible)


def turned(runs: Any) -> Any:
    """Return runs whose camera is mounted with an error of .03 rad."""
    return runs._replace(measurements=runs.measurements + np.array([0.03, 0]))


def noise_of(runs: Any, column: int) -> Array:
    """Return the noise of the bearings (0) or ranges (1), shape (B, T, L)."""
    exact = with_noise(runs, column, 0.0).measurements
    noise = (runs.measurements - exact)[..., column]
    return np.asarray(noise if column else wrap_angle(noise))


def scaled_far(world: Scenario, runs: Any) -> Any:
    """Return runs with 1.6 times the range noise beyond the median range."""
    noise = noise_of(runs, 1)
    far = runs.measurements[..., 1] > np.median(runs.measurements[..., 1][runs.visible])
    return with_noise(runs, 1, np.where(far, 1.6, 1.0) * noise)


def per_metre(world: Scenario, runs: Any) -> Any:
    """Return runs whose range noise grows by a standard deviation every 6 m."""
    noise = noise_of(runs, 1)
    ranges = runs.measurements[..., 1] - noise
    return with_noise(runs, 1, (0.6 + ranges / 6) * noise)


def long_ranges(world: Scenario, runs: Any) -> Any:
    """Return runs whose ranges are 2 % too long."""
    noise = noise_of(runs, 1)
    return with_noise(runs, 1, noise + 0.02 * (runs.measurements[..., 1] - noise))


def wild_bearings(world: Scenario, runs: Any) -> Any:
    """Return runs in which 5 % of the bearings have six times the noise."""
    wild = np.random.default_rng(7).random(runs.visible.shape) < 0.05
    return with_noise(runs, 0, np.where(wild, 6.0, 1.0) * noise_of(runs, 0))


def correlated_ranges(world: Scenario, runs: Any) -> Any:
    """Return runs whose noise of ranges is AR(1) with φ = .7."""
    noise = autoregressive(runs.visible.shape, phi=0.7, seed=8)
    return with_noise(runs, 1, world.sensor.std[1] * noise)


#: Faults that were written after the rules, and tried once.
LATER_FAULTS = (
    Fault(
        "innovation wrapped to [0, 2π)",
        (MODEL,),
        textbook("nu[::2] = wrap_angle(nu[::2])", "nu[::2] %= 2 * np.pi"),
    ),
    Fault(
        "Jacobian of the motion at the new heading",
        (COVARIANCE,),
        textbook(
            "G[:2, 2] = -d * s, d * c",
            "G[:2, 2] = -d * np.sin(self.x[2] + alpha), d * np.cos(self.x[2] + alpha)",
        ),
    ),
    Fault(
        "gain times .8",
        (COVARIANCE,),
        textbook(GAIN, GAIN.replace("K @ nu", "0.8 * K @ nu")),
    ),
    Fault(
        "covariance times 1.1 after each correction",
        (COVARIANCE,),
        textbook(GAIN, f"{GAIN}\n        self.P = 1.1 * self.P"),
    ),
    Fault(
        "range noise grows, which the filter ignores",
        ("range noise too small",),
        world=per_metre,
    ),
    Fault(
        "motion noise rotated by a later heading",
        (COVARIANCE,),
        textbook(
            "F[:2, :2] = (c, -s), (s, c)",
            "t = self.x[2] + 2 * alpha\n        "
            "F[:2, :2] = (np.cos(t), -np.sin(t)), (np.sin(t), np.cos(t))",
        ),
    ),
    Fault("dt²", (COVARIANCE,), SquaresDt),
    Fault(
        "ranges 2 % too long in the world",
        ("range bias", "range noise too small"),
        world=long_ranges,
    ),
    Fault("5 % wild bearings", ("heavy tails",), world=wild_bearings),
    Fault("every fifth scan repeated", (MODEL,), input=repeated),
    Fault(
        "new landmarks .2 m too far",
        (MODEL,),
        textbook(
            "np.array([r * c, r * s])", "np.array([r * c, r * s]) * (1 + 0.2 / r)"
        ),
    ),
    Fault("no motion noise in turns", (COVARIANCE,), ForgetsNoiseInTurns),
    Fault("range error AR(1), φ = .7", ("correlated noise",), world=correlated_ranges),
    Fault(
        "innovations clipped at one deviation",
        (COVARIANCE,),
        textbook(
            "K = np.linalg.solve(S, H @ self.P).T",
            "K = np.linalg.solve(S, H @ self.P).T\n        "
            "most = np.sqrt(np.diag(S))\n        nu = np.clip(nu, -most, most)",
        ),
    ),
    Fault(
        "gate at the median",
        (COVARIANCE,),
        textbook(
            GAIN, "K = K * (nu @ np.linalg.solve(S, nu) < len(nu))\n        " + GAIN
        ),
    ),
    Fault(
        "range noise 1.6 times beyond the median",
        ("range noise too small",),
        world=scaled_far,
    ),
    Fault("drift of the heading", (MODEL,), DriftsInHeading),
    Fault(
        "gain applied twice, covariance once",
        (COVARIANCE,),
        textbook(GAIN, GAIN.replace("K @ nu", "2 * K @ nu - K @ H @ K @ nu")),
    ),
    Fault("camera mounted with .03 rad", (MODEL,), input=turned),
    Fault("motion noise in every other step", (COVARIANCE,), AddsNoiseEveryOtherStep),
)
Change = Callable[[Array, Array], None]


def turn_map(mean: Array, _: Array) -> None:
    """Turn the map by .03 rad about the origin."""
    x, y = mean[3::2].copy(), mean[4::2].copy()
    mean[3::2], mean[4::2] = x - 0.03 * y, y + 0.03 * x


def stretch_map(mean: Array, _: Array) -> None:
    """Make the map 2 % larger."""
    mean[3:] *= 1.02


def rotate_identities(mean: Array, _: Array) -> None:
    """Give the first three landmarks each other's places."""
    mean[3:9] = np.roll(mean[3:9], 2)


def move_one(mean: Array, _: Array) -> None:
    """Move the second landmark by .1 m."""
    mean[6:7] += 0.1


def shrink_map(_: Array, covariance: Array) -> None:
    """Report 60 % of the variances of the map."""
    covariance[3:] *= np.sqrt(0.6)
    covariance[:, 3:] *= np.sqrt(0.6)


def inflate_one(_: Array, covariance: Array) -> None:
    """Report nine times the variance of the second landmark."""
    covariance[5:7] *= 3
    covariance[:, 5:7] *= 3


def mirror_ellipses(_: Array, covariance: Array) -> None:
    """Report covariances of the map with the wrong sign between x and y."""
    covariance[4::2] *= -1
    covariance[:, 4::2] *= -1


def swap_axes(_: Array, covariance: Array) -> None:
    """Take the x of a landmark for its y in the covariance."""
    order = np.arange(len(covariance))
    order[3::2], order[4::2] = order[4::2].copy(), order[3::2].copy()
    covariance[:] = covariance[order][:, order]


def reverse_order(_: Array, covariance: Array) -> None:
    """Give the landmarks the covariances in reverse order."""
    pairs = np.arange(3, len(covariance)).reshape(-1, 2)[::-1]
    order = np.concatenate([np.arange(3), pairs.ravel()])
    covariance[:] = covariance[order][:, order]


def halve_cross_covariance(_: Array, covariance: Array) -> None:
    """Report half of the covariances between pose and map."""
    covariance[:3, 3:] /= 2
    covariance[3:, :3] /= 2


MAP_FAULTS: tuple[Change, ...] = (
    turn_map,
    stretch_map,
    rotate_identities,
    move_one,
    shrink_map,
    inflate_one,
    mirror_ellipses,
    swap_axes,
    reverse_order,
    halve_cross_covariance,
)
MAP_WORLDS = "anchored", "six_landmarks"


def with_map(change: Change) -> type:
    """Return the invariant filter with a fault in the map that it reports."""

    class Reporting(InvariantEkfSlam):
        """Reports a wrong map."""

        def belief(self, landmark_ids: Any = None) -> Belief:
            """Report the pose as it is, and the map with the fault."""
            own = super().belief(landmark_ids)
            mean, covariance = own.mean.copy(), own.covariance.copy()
            if own.landmark_ids:
                change(mean, covariance)
            return Belief(mean, covariance, own.landmark_ids, own.frame)

        def predict(self, odometry: Any, dt: float = 1.0) -> None:
            """Move as usual, but not in a batch, which has a belief of its own."""
            super().predict(odometry, dt)

    return Reporting


UNSURE = {"start": {"std": [0.3, 0.3, 0.001], "drawn": "truth"}}
WORLDS = {
    "anchored": load_scenario("anchored"),
    "loop, noise × .3": runner.with_less_noise(
        load_scenario("loop").with_changes(steps=250), 0.3
    ),
    "dropout": load_scenario("dropout").with_changes(steps=130, **UNSURE),
}
LATER_WORLDS = {
    "six_landmarks, noise × .3": runner.with_less_noise(
        load_scenario("six_landmarks"), 0.3
    ),
    "loop, noise × .3": runner.with_less_noise(
        load_scenario("loop").with_changes(steps=100), 0.3
    ),
    "corridor": load_scenario("corridor").with_changes(steps=70),
}
HONEST_WORLDS = (*WORLDS.values(), load_scenario("corridor").with_changes(steps=100))


@contextmanager
def changed_runs(fault: Fault) -> Iterator[None]:
    """Change the world of a Monte Carlo, and what its filter reads."""
    simulate: Any = vars(runner)["simulate_runs"]
    use: Any = vars(runner)["filter_runs"]

    def simulated(world: Scenario, *arguments: Any, **options: Any) -> Any:
        return fault.world(world, simulate(world, *arguments, **options))

    def filtered(settings: Any, runs: Any, **options: Any) -> Any:
        return use(settings, fault.input(runs), **options)

    with (
        mock.patch.object(runner, "simulate_runs", simulated),
        mock.patch.object(runner, "filter_runs", filtered),
    ):
        yield


def answer(world: Scenario, fault: Fault, runs: int, seed: int) -> dict[str, Any]:
    """Return the entry of the summary of one study."""
    with changed_runs(fault):
        results = monte_carlo(
            world, {"filter": fault.estimator}, runs, seed, small_noise=True
        )
    entry: dict[str, Any] = summarise_monte_carlo(results)["estimators"]["filter"]
    return entry


def rating(fault: Fault, entry: dict[str, Any]) -> str:
    """Rate an answer: "right", "undecided" or "wrong"."""
    cause = entry["diagnosis"]["cause"]
    is_accepted = entry["verdict"] in ("consistent", "nearly consistent")
    if entry["diagnosis"]["sentence"].startswith(WRONG_COVARIANCES_OF_MAPS):
        cause = COVARIANCE
    if cause in fault.right or (is_accepted and cause in ("honest", CANNOT_TELL)):
        return "right"
    is_open = entry["diagnosis"]["sentence"].endswith(" explains this.")  # of a map
    return "undecided" if cause == CANNOT_TELL or is_open else "wrong"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7_000_000)
    parser.add_argument("--faults", nargs="+", help="only names that contain one")
    parser.add_argument("--later", action="store_true", help="other faults and worlds")
    parser.add_argument("--map", action="store_true", help="wrong maps")
    parser.add_argument("--no-honest", action="store_true")
    parser.add_argument("--sentences", action="store_true")
    given = parser.parse_args(arguments)
    if given.map:
        judge_maps(given.runs, given.seed, given.sentences)
        return
    ratings: Counter[str] = Counter()
    linear = 0
    print("| fault | world | NEES / 3 | verdict | answer | rating |")
    print("|---|---|---|---|---|---|")
    faults, worlds = (LATER_FAULTS, LATER_WORLDS) if given.later else (FAULTS, WORLDS)
    for fault in faults:
        if given.faults and not any(name in fault.name for name in given.faults):
            continue
        for name, world in worlds.items():
            entry = answer(world, fault, given.runs, given.seed)
            rated, cause = rating(fault, entry), entry["diagnosis"]["cause"]
            ratings[rated] += 1
            linear += cause == "linearisation"
            ratio = entry["pose_nees"]["invariant"]["mean"]
            nees = "–" if ratio is None else f"{ratio:.3g}"
            row = fault.name, name, nees, entry["verdict"], cause, rated
            print(f"| {' | '.join(row)} |", flush=True)
            if given.sentences:
                print("   ", entry["diagnosis"]["sentence"])
    total = ratings.total()
    shares = ", ".join(f"{word} {n} of {total}" for word, n in ratings.most_common())
    print(f"\n{shares}; called linearisation: {linear}")
    if not given.no_honest:
        alarms = honest_alarms(given.runs, given.seed + 1_000_000)
        print(f"false alarms in {len(alarms)} honest studies: {sum(alarms)}")


def honest_alarms(runs: int, seed: int) -> list[bool]:
    """Return for 20 studies of consistent filters whether they name a cause."""
    found = []
    for repetition in range(5):
        for number, world in enumerate(HONEST_WORLDS):
            first = seed + runs * (repetition * len(HONEST_WORLDS) + number)
            entry = answer(world, Fault("", (), "invariant"), runs, first)
            cause = entry["diagnosis"]["cause"]
            found.append(cause not in ("honest", CANNOT_TELL))
    return found


def judge_maps(runs: int, seed: int, with_sentences: bool) -> None:
    """Print how many wrong maps are refused, and how many correct ones."""
    print("| fault of the map | world | map NEES | verdict | answer |")
    print("|---|---|---|---|---|")
    refused = 0
    wrong = {change.__name__: with_map(change) for change in MAP_FAULTS}
    for world in MAP_WORLDS:
        summary = summarise_monte_carlo(monte_carlo(world, wrong, runs, seed))
        for name, entry in summary["estimators"].items():
            refused += entry["verdict"] == "not consistent"
            ratio = entry["nees_end"]["relative_map"]
            nees, cause = "–" if ratio is None else f"{ratio:.3g}", entry["diagnosis"]
            row = name.replace("_", " "), world, nees, entry["verdict"], cause["cause"]
            print(f"| {' | '.join(row)} |", flush=True)
            if with_sentences:
                print("   ", entry["sentence"], cause["sentence"])
    print(f"\nrefused: {refused} of {len(MAP_FAULTS) * len(MAP_WORLDS)}")
    words: Counter[str] = Counter()
    for repetition in range(20):
        world, first = MAP_WORLDS[repetition % 2], seed + 1_000_000 + runs * repetition
        results = monte_carlo(world, "invariant", runs, first)
        entry = summarise_monte_carlo(results)["estimators"]["invariant"]
        words[entry["verdict"]] += 1
    found = ", ".join(f"{word} {n}" for word, n in words.most_common())
    print(f"without a fault: {found}")


if __name__ == "__main__":
    main()
