"""Sparse information filter: time and memory against map size, NEES against pruning.

    python benchmarks/sparse_information.py                # maps of 1000 and 10,000
    python benchmarks/sparse_information.py --sizes 100000
    python benchmarks/sparse_information.py --nees         # minutes
    python benchmarks/sparse_information.py --error --sizes 300 1000
    python benchmarks/sparse_information.py --splu --sizes 100000

The robot sees the ten nearest landmarks in each step.  The large map is built without a
drive: one scan per landmark, from a place beside it without prior knowledge, adds its
information about the ten landmarks around, and the landmarks near the start fix the
frame.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from functools import partial
from resource import RUSAGE_SELF, getrusage
from time import perf_counter, thread_time
from typing import Any, NamedTuple

import numpy as np
import submaps
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from slamgym.estimator.large_maps.compressed.compressed_slam import CompressedEkfSlam
from slamgym.estimator.large_maps.elimination import LandmarkElimination
from slamgym.estimator.large_maps.sparse_information.sparse_information_slam import (
    SparseInformationSlam,
)
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.models.sensors import BEARING_RANGE
from slamgym.evaluation.nees import pose_nees
from slamgym.experiments.run_and_replay.simulated_runs import (
    SimulatedRuns,
    simulate_runs,
)
from slamgym.sim_configs import Scenario, load_scenario

Array = NDArray[np.float64]

SEEN = 10
MOTION_STD, MEASUREMENT_STD = np.array([0.02, 0.01, 0.01]), np.array([0.01, 0.05])
CHUNK = 5000
DRIVES = {300: 20, 1000: 10, 3000: 3}  # up to so many landmarks; over larger maps one
CONSOLE = Console(width=110)


class Step(NamedTuple):
    """The input of a filter."""

    odometry: Array
    readings: Array
    ids: NDArray[np.int64]


def town(count: int) -> Array:
    """Landmarks, one per 25 m²: (count, 2) [m]."""
    half = np.sqrt(25.0 * count) / 2
    return np.random.default_rng(0).uniform(-half, half, (count, 2))


def known_map(landmarks: Array) -> SparseInformationSlam:
    """Make a filter that has mapped all landmarks, with the robot at the origin."""
    tree, count = cKDTree(landmarks), len(landmarks)
    places = landmarks + np.random.default_rng(1).normal(0.0, 2.0, landmarks.shape)
    total = csr_array((2 * count, 2 * count))
    for first in range(0, count, CHUNK):
        chunk = places[first : first + CHUNK]
        total = total + _information_of(chunk, landmarks, tree)
    anchored = np.repeat(tree.query(np.zeros(2), SEEN)[1] * 2, 2)
    anchored[1::2] += 1
    fixed = np.full(len(anchored), 1e4)
    total = total + csr_array((fixed, (anchored, anchored)), shape=total.shape)
    total = ((total + total.T) / 2).tobsr(blocksize=(2, 2))
    slam = SparseInformationSlam(
        MOTION_STD, MEASUREMENT_STD, initial_pose_std=(0.1, 0.1, 0.1), dense_limit=0
    )
    slam.update([(0.0, 5.0)], [0])  # the state is then one in information form
    slam.remove([0])
    slam.load_state_dict(
        slam.state_dict()
        | {
            "landmark_ids": np.arange(count),
            "slots": np.arange(count),
            "free": np.arange(0),
            "points": landmarks.ravel(),
            "first": landmarks.ravel(),
            "nodes": np.zeros(count, dtype=np.int64),
            "matrix_counts": np.diff(total.indptr),
            "matrix_links": total.indices,
            "matrix_blocks": total.data,
        }
    )
    return slam


def _information_of(places: Array, landmarks: Array, tree: cKDTree) -> csr_array:
    """Sum over scans of H_lᵀ (1 − H_p (H_pᵀ H_p)⁻¹ H_pᵀ) H_l, all whitened."""
    m, size = len(places), 2 * len(landmarks)
    seen = tree.query(places, SEEN)[1]
    H_p, H_l = np.empty((m, 2 * SEEN, 3)), np.zeros((m, 2 * SEEN, 2 * SEEN))
    for k in range(m):
        pose = np.append(places[k], 0.0)
        expected = predict_measurement(pose, landmarks[seen[k]])
        H_p[k] = (expected.jacobian_pose / MEASUREMENT_STD[:, None]).reshape(-1, 3)
        blocks = expected.jacobian_landmark / MEASUREMENT_STD[:, None]
        for j in range(SEEN):
            H_l[k, 2 * j : 2 * j + 2, 2 * j : 2 * j + 2] = blocks[j]
    cross = H_p.transpose(0, 2, 1) @ H_l
    info = H_l.transpose(0, 2, 1) @ H_l - cross.transpose(0, 2, 1) @ np.linalg.solve(
        H_p.transpose(0, 2, 1) @ H_p, cross
    )
    columns = np.stack([2 * seen, 2 * seen + 1], axis=2).reshape(m, -1)
    rows = np.repeat(columns, 2 * SEEN, axis=1).ravel()
    both = (rows, np.tile(columns, (1, 2 * SEEN)).ravel())
    return csr_array((info.ravel(), both), shape=(size, size))


def drive(landmarks: Array, steps: int, seed: int = 0) -> Iterator[Step]:
    """Drive from place to place, half a metre per step."""
    rng, tree = np.random.default_rng(seed), cKDTree(landmarks)
    pose, goal = np.zeros(3), np.zeros(2)
    half = np.abs(landmarks).max()
    for step in range(steps):
        if step % 100 == 0:
            goal = np.clip(pose[:2] + rng.uniform(-60, 60, 2), -half, half)
        way = goal - pose[:2]
        ahead = np.arctan2(way[1], way[0]) - pose[2]
        turn = np.clip((ahead + np.pi) % (2 * np.pi) - np.pi, -0.3, 0.3)
        motion = predict_pose(pose, np.array([0.5, turn]))
        pose = motion.pose + motion.jacobian_noise @ (
            MOTION_STD * rng.standard_normal(3)
        )
        ids = tree.query(pose[:2], SEEN)[1]
        readings = predict_measurement(pose, landmarks[ids]).measurement
        noise = MEASUREMENT_STD * rng.standard_normal(readings.shape)
        yield Step(np.array([0.5, turn]), readings + noise, ids)


class Cost(NamedTuple):
    """The costs of a map of one size."""

    landmarks: int
    links: float
    """Blocks of Λ per landmark."""
    mean: float
    median: float
    worst: float
    """Of a step [ms]."""
    megabytes: float
    """Of map and local map."""
    peak: float
    """Largest memory of the process so far, all its libraries included [GB]."""
    pose_belief: float
    """First ``belief([])`` among new landmarks [s]; nan where not asked for."""


def cost(count: int, steps: int = 300, *, largest_belief: int = 10_000) -> Cost:
    """Drive through a known map and measure, in CPU time of this thread."""
    landmarks = town(count)
    slam, times = known_map(landmarks), []
    for odometry, readings, ids in drive(landmarks, steps):
        start = thread_time()
        slam.predict(odometry)
        slam.update(readings, ids)
        times.append(1e3 * (thread_time() - start))
    start, asked = thread_time(), count <= largest_belief
    if asked:
        slam.belief([])
    return Cost(
        count,
        slam.link_count / count,
        float(np.mean(times[1:])),
        float(np.median(times[1:])),
        float(np.max(times[1:])),
        slam.nbytes / 1e6,
        getrusage(RUSAGE_SELF).ru_maxrss / 1e6,
        thread_time() - start if asked else np.nan,
    )


def elimination_costs(count: int, steps: int = 300) -> tuple[Array, float]:
    """Return CPU times [s] of each elimination of a drive, and of scipy's at the last.

    scipy factorises the eliminated landmarks, and solves for the Schur complement.
    """
    landmarks, times = town(count), []
    slam, own = known_map(landmarks), LandmarkElimination.eliminate
    last: list[Any] = []

    def timed(self: Any, matrix: Any, local: Any) -> Any:
        start = thread_time()
        found = own(self, matrix, local)
        times.append(thread_time() - start)
        last[:] = matrix, found
        return found

    LandmarkElimination.eliminate = timed  # type: ignore[method-assign]
    try:
        for odometry, readings, ids in drive(landmarks, steps):
            slam.predict(odometry)
            slam.update(readings, ids)
    finally:
        LandmarkElimination.eliminate = own  # type: ignore[method-assign]
    matrix, found = last  # before the rows of the last local map changed
    inner = matrix.submatrix(found.slots, found.slots).tocsc()
    outer = matrix.submatrix(found.slots, found.border).toarray()
    start = thread_time()
    symmetric = {"SymmetricMode": True}
    factor = splu(inner, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    complement = outer.T @ factor.solve(outer)
    other = thread_time() - start
    np.testing.assert_allclose(complement, found.complement, rtol=1e-6)
    return np.array(times), other


class Case(NamedTuple):
    """A scenario for the table of NEES, and the largest number of active landmarks."""

    scenario: str
    bound: int
    blocks: int | None = None
    """Blocks along either side of a smaller city, driven around once."""

    @property
    def name(self) -> str:
        """Of its row."""
        size = f", {self.blocks} × {self.blocks} blocks"
        return self.scenario + (size if self.blocks else "")

    def world(self) -> Scenario:
        """Load the scenario, and make it smaller if required."""
        world = load_scenario(self.scenario)
        if not self.blocks:
            return world
        size = {"columns": self.blocks, "rows": self.blocks}
        steps = 58 * self.blocks**2
        return world.with_changes(steps=steps, landmarks=size, controls=size)


CASES = (
    Case("anchored", 4),
    Case("dense", 12),
    Case("loop", 4),
    Case("loop", 8),
    Case("city", 12, blocks=3),
    Case("city", 20, blocks=3),
)
HONEST = "observability_constrained"
KINDS: dict[str, dict[str, Any]] = {
    "ekf": {},
    "relocate": {},
    "relocate, constrained": {"base": HONEST},
    "prune": {"sparsify": "prune"},
}


def nees(case: Case, runs: int) -> dict[str, Array]:
    """NEES / 3 of the pose per run, in the additive frame, every tenth step."""
    scores: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for run in range(runs):
        world = case.world()
        data = simulate_runs(world, 1, run)
        for kind in KINDS:
            scores[kind].append(_follow(world, data, kind, case.bound))
    return {kind: np.array(values) for kind, values in scores.items()}


def _follow(world: Scenario, data: SimulatedRuns, kind: str, bound: int) -> float:
    """Filter a run; :class:`CompressedEkfSlam` stands for the EKF."""
    noise: dict[str, Any] = {
        "motion_std": world.motion.std,
        "measurement_std": world.sensor.std,
        "sensor": BEARING_RANGE.with_noise(
            range_std_per_metre=world.sensor.range_std_per_metre
        ),
        "initial_pose_std": world.start.std,
        "initial_pose": data.initial_poses[0],
    }
    slam: Any = (
        CompressedEkfSlam(**noise)
        if kind == "ekf"
        else SparseInformationSlam(
            active_bound=bound, dense_limit=0, **KINDS[kind], **noise
        )
    )
    scores = []
    for step, odometry in enumerate(data.odometry[0]):
        slam.predict(odometry, data.dt[step])
        ids = np.flatnonzero(data.visible[0, step])
        slam.update(data.measurements[0, step, ids], ids)
        if step % 10 == 9:
            belief, truth = slam.belief([]), data.true_poses[0, step]
            scores.append(
                pose_nees(truth, belief.pose, belief.pose_covariance, frame="additive")
            )
    return float(np.mean(scores)) / 3


class Error(NamedTuple):
    """A filter at the end of the drives of the overview (submaps.py)."""

    error: float
    """Of the position, root mean square [m]."""
    std: float
    """Reported by the filter, mean [m]."""
    nees: float
    """Of the pose, per dimension, in the frame of the filter, mean."""
    apart: float
    """Distance to the "ekf" on the same drive, root mean square [m]."""
    aligned: float
    """Distance to the invariant filter on the same drive, root mean square [m]."""


OF_ERROR: dict[str, Callable[..., Any]] = {
    "ekf": CompressedEkfSlam,
    "invariant": partial(CompressedEkfSlam, base="invariant"),
    "relocate": SparseInformationSlam,
    "… active_bound=10": partial(SparseInformationSlam, active_bound=10),
    "… active_bound=40": partial(SparseInformationSlam, active_bound=40),
    "… first_estimates": partial(SparseInformationSlam, base="first_estimates"),
    "… constrained": partial(SparseInformationSlam, base=HONEST),
}


def errors(count: int, drives: int) -> dict[str, Error]:
    """Give the same readings to all filters, row by row over an unknown map."""
    ends: dict[str, list[Array]] = {name: [] for name in OF_ERROR}
    for seed in range(drives):
        half = np.sqrt(25.0 * count) / 2
        landmarks = np.random.default_rng(seed).uniform(-half, half, (count, 2))
        start = np.array([-half, -half, 0.0])
        steps = list(submaps.drive(landmarks, half, start, seed=seed + 1))
        for name, make in OF_ERROR.items():
            noise = (submaps.MOTION_STD, submaps.MEASUREMENT_STD)
            slam = make(*noise, initial_pose=start)
            for step in steps:
                slam.predict(step.odometry)
                slam.update(step.readings, step.ids)
            belief, truth = slam.belief([]), steps[-1].pose
            P = belief.pose_covariance
            score = pose_nees(truth, belief.pose, P, frame=belief.frame) / 3
            std = np.sqrt(P[0, 0] + P[1, 1])
            off = belief.pose[:2] - truth[:2]
            ends[name].append(np.array([*off, std, score]))
    table = {name: np.array(rows) for name, rows in ends.items()}

    def distance(one: Array, other: Array | float = 0.0) -> float:
        return float(np.sqrt(((one - other)[:, :2] ** 2).sum(axis=1).mean()))

    return {
        name: Error(
            distance(rows),
            float(rows[:, 2].mean()),
            float(rows[:, 3].mean()),
            distance(rows, table["ekf"]),
            distance(rows, table["invariant"]),
        )
        for name, rows in table.items()
    }


def print_costs(sizes: list[int]) -> None:
    table = Table(title=f"{SEEN} nearest seen per step, CPU time")
    for name in (
        "landmarks",
        "links each",
        "mean ms",
        "median ms",
        "worst ms",
        "MB",
        "GB",
    ):
        table.add_column(name, justify="right")
    table.add_column("belief([]) s", justify="right")
    for size in sizes:
        row = cost(size)
        table.add_row(str(size), *(f"{value:.3g}" for value in row[1:]))
    CONSOLE.print(table)


def print_eliminations(sizes: list[int]) -> None:
    """Print the times of the elimination beside those of a factorisation by scipy."""
    print("| landmarks | first, s | changes | mean, s | splu, s |\n|" + "---:|" * 5)
    for size in sizes:
        (first, *later), other = elimination_costs(size)
        cells = (f"{first:.3g}", len(later), f"{np.mean(later):.3g}", f"{other:.3g}")
        print(f"| {size} |", " | ".join(map(str, cells)), "|", flush=True)


def print_nees(runs: int) -> None:
    """Print the row of each case as soon as it is known."""
    print(f"NEES of the pose per dimension, {runs} runs: mean (median)")
    print("| scenario | Γ |", " | ".join(KINDS), "|")
    print("|---|---:|" + "---:|" * len(KINDS))
    for case in CASES:
        scores = nees(case, runs).values()
        cells = (f"{np.mean(s):.3g} ({np.median(s):.3g})" for s in scores)
        print(f"| {case.name} | {case.bound} |", " | ".join(cells), "|", flush=True)


def print_errors(sizes: list[int]) -> None:
    """Print the errors of the filters, over as many drives as in the overview."""
    print("| landmarks | filter | error, m | std, m | NEES / 3 | from ekf, m", end="")
    print(" | from invariant, m | drives |\n| ---: | --- |" + " ---: |" * 6)
    for count in sizes:
        drives = next((n for most, n in DRIVES.items() if count <= most), 1)
        for name, row in errors(count, drives).items():
            cells = (f"{value:.2f}" for value in row)
            print(f"| {count} | {name} |", " | ".join(cells), f"| {drives} |")


def main() -> None:
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="*", default=[1000, 10_000])
    parser.add_argument("--nees", action="store_true")
    parser.add_argument("--error", action="store_true")
    parser.add_argument("--splu", action="store_true")
    parser.add_argument("--runs", type=int, default=20)
    arguments = parser.parse_args()
    start = perf_counter()
    if arguments.nees:
        print_nees(arguments.runs)
    elif arguments.splu:
        print_eliminations(arguments.sizes)
    elif arguments.error:
        print_errors(arguments.sizes)
    else:
        print_costs(arguments.sizes)
    CONSOLE.print(f"{perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
