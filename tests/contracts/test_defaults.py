"""Defaults and limits that results depend on, for all who choose no others.

Another value changes the results for the same seed, as the changelog lists it.
"""

import importlib
from inspect import Parameter, signature
from math import pi

import pytest

from slamgym import agents, estimator
from slamgym.agents.active_slam_task import RewardWeights
from slamgym.agents.landmark_set import ObservationForm
from slamgym.estimator.association.scan_assignments import AssociationPolicy, Noise
from slamgym.estimator.map_management.policy import FieldOfView
from slamgym.estimator.models.motions import UNICYCLE, MotionNoise

NOWHERE = (0.0, 0.0, 0.0)
START = {"initial_pose": NOWHERE, "initial_pose_std": NOWHERE}
DRIVE = {"sensor": "bearing_range", "noise_at_rest": True, "min_range": 1e-3}
DRIVE |= {"motion": UNICYCLE, **START}
FILTER = {**DRIVE, "landmark_init": "full", "gate_probability": None}
ASSOCIATION = {
    **{"association": "auto", "density": None, "hypotheses": 10, "branches": 4},
    **{"search_nodes": 2000, "pair_gate": 15.0, "backdate": True, "match_gate": 9.21},
    **{"new_gate": 25.0, "ambiguity": 1.0, "confirm": (3, 8), "trust_ids": True},
}
MANAGEMENT = {"view": None, "remove_after": None, "merge_within": None}
MANAGEMENT |= {**ASSOCIATION, "merge_gate": 9.21, "capacity": None}
ROBUST = {"robust": None, "robust_scale": None}
IN_LOOP = {"estimator": "invariant", "estimator_options": None}
ACTIVE = {**IN_LOOP, "scenario": "active_medium", "render_mode": None}
DEFAULTS = [
    (estimator.EkfSlam, FILTER),
    (estimator.FirstEstimatesEkfSlam, FILTER),
    (estimator.UnscentedSlam, FILTER),
    (estimator.RobocentricEkfSlam, FILTER),
    (estimator.IdealEkfSlam, FILTER),
    (estimator.InvariantEkfSlam, {"iterations": 10}),
    (estimator.IteratedEkfSlam, {"iterations": 3}),
    (estimator.CompressedEkfSlam, {**START, "base": "ekf", "local_size": None}),
    (
        estimator.SparseInformationSlam,
        {
            **{**START, "base": "ekf", "active_bound": 20, "sparsify": "relocate"},
            "belief_limit": 5000,
        },
    ),
    (
        estimator.SubmapSlam,
        {
            **{**START, "base": "invariant", "submap_size": None, "folder": None},
            **{"heading_limit": None, "extent_limit": None, "belief_limit": 5000},
        },
    ),
    (estimator.ManagedSlam, {"management": True}),
    (estimator.make_estimator, {**START, "management": None}),
    (AssociationPolicy, ASSOCIATION),
    (estimator.LandmarkPolicy, MANAGEMENT),
    (
        estimator.Constellations,
        {
            **{"least": 6, "margin": 3, "lost_std": 2.0, "search_nodes": 20_000},
            "always": False,
        },
    ),
    (
        FieldOfView,
        {
            **{"min_range": 0.0, "angle": 2 * pi, "range_margin": 0.5},
            **{"bearing_margin": 0.05, "shadow": 0.0, "visible": None},
        },
    ),
    (Noise, {"range_std_per_metre": 0.0, "bearing_std_metres": 0.0}),
    (MotionNoise, {"at_rest": True, "motion": UNICYCLE}),
    (estimator.Drive, DRIVE),
    (estimator.SmoothingSlam, {**DRIVE, **ROBUST, "follow": "invariant"}),
    (
        estimator.smooth,
        {
            **{**ROBUST, "start": None, "landmarks": None, "tolerance": 1e-9},
            **{"iterations": 100, "associate": False},
        },
    ),
    (estimator.check_sensor, {"measurement_std": (0.1, 0.1), "trials": 200}),
    (estimator.check_motion, {"trials": 1000}),
    (
        RewardWeights,
        {
            **{"criterion": "D", "accuracy": 0.25, "success_reward": 5.0},
            **{"crash_cost": 5.0, "effort_cost": 0.0, "step_cost": 0.02},
        },
    ),
    (
        ObservationForm,
        {"observation": "flat", "max_landmarks": None, "dtype": "float64"},
    ),
    (agents.ActiveSlamEnv, ACTIVE),
    (agents.ActiveSlamVectorEnv, {**ACTIVE, "num_envs": 1, "max_episode_steps": None}),
    (agents.BeliefObservation, {**IN_LOOP, "max_landmarks": None}),
    (agents.BeliefObservationVector, {**IN_LOOP, "max_landmarks": None}),
    (
        agents.InformationReward,
        {
            **{"criterion": "D", "prior_std": None, "gain": 1.0},
            **{"collision_cost": 0.0, "effort_cost": 0.0},
        },
    ),
]
IGNORED = {"constellations", "autoreset_mode"}  # not plain values


@pytest.mark.parametrize(
    ("made", "expected"), DEFAULTS, ids=[made.__name__ for made, _ in DEFAULTS]
)
def test_what_is_left_out_has_the_value_that_is_documented(made, expected):
    given = {
        name: each.default
        for name, each in signature(made).parameters.items()
        if each.default is not Parameter.empty
    }
    others = IGNORED - expected.keys()
    assert {k: v for k, v in given.items() if k not in others} == expected


LIMITS = {
    "estimator.association.constellations": (
        {"LARGEST_GRAPH": 800, "DISTANCE_GATE": 10.83, "RIVAL_SHARE": 0.75}
        | {"RIVAL_GAP": 3.0, "TAIL": 1e-4, "PAIR_GATE": 13.8, "PARTNERS": 0.6}
    ),
    "estimator.association.missed_landmarks": (
        {"HIDDEN": 3e-4, "SUREST": 0.95, "WIDEST": pi / 4, "FEWER": 0.5, "LIMIT": 3.0}
        | {"HIDDEN_EACH": 5, "NO_RETURNS": 100, "SCANS": 5, "TELLING": 0.3}
        | {"SHADOW": 0.1, "MARGIN": 0.5, "LOST_SCORE": 3.0, "MOST_OF_SCAN": 3.0}
        | {"UNKNOWN": 0.8, "PROVEN": 2, "UNIFORM": pi**2 / 3}
    ),
    "estimator.association.scan_assignments": (
        {"BRANCH_SPREAD": 16.0, "SAME": 1.0, "MOST_SCANS": 63}
    ),
    "estimator.association.tentative_landmarks": (
        {"SECTORS": 16, "RINGS": 8, "MEMORY": 0.98, "BEYOND": 4.0, "STRAIGHT": 0.05}
        | {"LEAST_SHARE": 0.01, "ENTRY_ODDS": 3.0}
    ),
    "estimator.map_management.clear_scans": {"SPREAD": 40.0},
    "estimator.map_management.loop_closing": (
        {"LOCAL_REACH": 3.0, "OFFSET_GATE": 25.0, "SAME_GATE": 9.21, "LOCAL_STD": 0.5}
        | {"ACCURATE": 0.25, "NEAR_STDS": 10.0, "TURN_STDS": 4.0, "SLACK": 0.2}
        | {"TURNS": 4, "FEWEST_READINGS": 3, "MOST_PLACES": 4}
    ),
    "estimator.map_management.managed_slam": (
        {"TRIED": 4, "MOST_OVERLAPPING": 3, "MOST_ASTRAY": 3, "OVERLAP": 0.5}
    ),
    "estimator.filters.delayed_landmarks": (
        {"MOST_POSES": 40, "ALIKE": 1e-3, "CERTAIN": 10.0, "BENT": 0.1, "SAME": 0.02}
        | {"UNLIKELY": 23.0, "DIRECTIONS": 24, "MOST_STEPS": 20, "SETTLED": 1e-4}
    ),
    "estimator.filters.drive_likelihood": {"GATE": 30.0},
    "estimator.large_maps.compressed.compressed_map": (
        {"LARGEST_WHOLE_MAP": 350, "LARGEST_WHOLE_INVARIANT": 400, "SHORT_PHASE": 4}
        | {"SMALLEST_LOCAL_MAP": 30, "LARGEST_RATIO": 2.5, "LANDMARKS_PER_RATIO": 250}
    ),
    "estimator.large_maps.sparse_information.local_information": (
        {"LARGEST_HEADING_STD": 0.3, "SMALLEST_LOCAL_MAP": 50}
        | {"SCALE": 2, "EXPONENT": 0.4}
    ),
    "estimator.large_maps.submaps.closed_submaps": (
        {"LARGEST_COUNT": 1000, "MARGIN": 2.0, "RECENT_SCANS": 10}
        | {"ROUGHLY_CONVERGED": 0.1}
    ),
    "estimator.large_maps.submaps.factor": {"SMALLEST_RATIO": 1e-5},
    "estimator.large_maps.submaps.graph": {"SIZE": 50, "ORIGIN": NOWHERE},
    "estimator.large_maps.submaps.joining": (
        {"CONVERGED": 1e-9, "ITERATIONS": 200, "HALVINGS": 8, "PATIENCE": 30}
    ),
    "estimator.large_maps.submaps.store": {"CACHE_SIZE": 8},
    "estimator.peers.peer_slam": {"START_FLOOR": 1e-6},
    "estimator.smoother.batch_smoother": (
        {"ITERATIONS": 5, "SCALES": {"huber": 1.345, "cauchy": 2.3849}}
    ),
    "estimator.smoother.optimiser": (
        {"REWEIGHTED": 30, "SHRINKING": 0.5, "NOTHING": 0.02, "SETTLED": 1e-6}
        | {"SEARCHES": 5, "RELOCATED": 5, "FIRST_DAMPING": 1e-4, "MOST_DAMPING": 1e10}
        | {"CANDIDATES": 12, "GAIN": 4.0}
    ),
    "estimator.smoother.reassociation": (
        {"PRICE": 6.0, "LEAST": 3, "SIGNIFICANT": 0.1, "CHANCE": 12.0, "ROUNDS": 8}
        | {"BIRTHS": 10, "SEEDS": 150, "GAP": 30, "PARTS": 8, "LARGEST_TURN": 1.5}
        | {"MATCHES": 2, "SMALLEST_CLIQUE": 3, "NODES": 20_000, "TOLERANCE": 0.03}
        | {"ITERATIONS": 30}
    ),
    "agents.active_slam_baselines": {"_DOTS": 2.0, "_ALIGNED": 0.4, "_PATIENCE": 26},
    "agents.active_slam_kernels": (
        {"CELLS": 8.0, "SECTORS": 8, "NEAR_REACH": 0.1, "FAR_REACH": 0.4}
    ),
    "agents.active_slam_scores": {"VALIDATION": 1_000_000, "HELD_OUT": 2_000_000},
    "agents.belief_features": {"SMALLEST_STD": 1e-3, "LARGEST_STD": 10.0},
    "agents.belief_space_planner": (
        {"_CLEARANCE": 0.5, "_ALIGNED": 0.5}
        | {"MPC": (40, (40,), 6, 3.0, 0.9, 0.3, 0.3, 0.06)}
        | {"GREEDY": (20, (2, 5, 10), 0, 3.0, 0.9, 0.3, 0.3, 0.06)}
    ),
    "agents.landmark_set": {"SCALE": 10.0, "_ROWS": 32},
    "agents.wall_routes": (
        {"CLEARANCE": 1.0, "_GAP": 0.5, "_WIDER": 1.2}
        | {"_CELLS_PER_SIDE": 24, "_SMALLEST_CELL": 0.75}
    ),
}


@pytest.mark.parametrize("name", LIMITS)
def test_limits_without_a_formula_are_those_of_the_benchmarks(name):
    module = importlib.import_module(f"slamgym.{name}")
    assert {key: vars(module)[key] for key in LIMITS[name]} == LIMITS[name]
