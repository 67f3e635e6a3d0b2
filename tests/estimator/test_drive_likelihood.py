"""The likelihood of a drive in one compiled call, against the filters' own calls."""

import numpy as np
import pytest
from drives import MEASUREMENT_STD, MOTION_STD, drive
from far_origins import far_origins, rounding

from slamgym.estimator import UnscentedSlam, make_estimator
from slamgym.estimator.filters.drive_likelihood import DriveEvents, drive_likelihood
from slamgym.estimator.kernels.scan_update import ADDED, GATED, SKIPPED
from slamgym.estimator.models import Motion

NOISE = np.array([*MOTION_STD, *MEASUREMENT_STD, 0.01, 0.02])
OMNI = Motion("omni", ("ahead", "left"), ("m", "m"), lambda a, b: (a, b, 0 * a))
GATE_PROBABILITY = 0.95
GATE = -2 * np.log1p(-GATE_PROBABILITY)


def events(seed=5, steps=40):
    """Return a drive with two motions per step, and one step without a scan.

    One of the two motions is a turn, and one has no noise. In step 10, both are turns
    without noise.
    """
    rng = np.random.default_rng(seed)
    motions, scans = [], []
    for (d, alpha), readings, _ in drive(seed, steps):
        turn, move = (0.0, alpha / 2), (d, alpha / 2)
        pairs = (
            [(*turn, 0.0), (*move, 1.0)],
            [(*move, 0.0), (*turn, 1.0)],
            [(*move, 1.0), (*turn, 0.0)],
        )
        motions += [(*turn, 0.0)] * 2 if len(scans) == 10 else pairs[len(scans) % 3]
        seen = np.flatnonzero(rng.random(6) < 0.6)
        scans.append((readings[seen], seen))
    scans[7] = scans[7][0][:0], scans[7][1][:0]
    scans[20][0][:1, 1] = 1e-4  # too near to use
    counts = np.cumsum([0, *(len(ids) for _, ids in scans)])
    return DriveEvents(
        np.array(motions),
        2 * np.arange(steps + 1),
        np.concatenate([readings for readings, _ in scans]),
        np.concatenate([ids for _, ids in scans]),
        counts,
    )


def filter_of(name, noise=NOISE, **options):
    return make_estimator(
        name,
        motion_std=noise[:3],
        measurement_std=noise[3:5],
        range_std_per_metre=noise[5],
        bearing_std_metres=noise[6],
        initial_pose=(1.0, -2.0, 0.3),
        initial_pose_std=(0.1, 0.1, 0.05),
        **options,
    )


def density(report):
    """Return log N(ν; 0, S) of the readings that a filter used."""
    nu, S = report.innovation.ravel(), report.innovation_covariance
    if not len(nu):
        return 0.0
    sign, log_det = np.linalg.slogdet(2 * np.pi * S)
    assert sign > 0
    return -0.5 * (nu @ np.linalg.solve(S, nu) + log_det)


@far_origins
def test_a_drive_far_from_the_origin_is_as_likely_to_the_bit(far):
    slam, there = filter_of("invariant"), filter_of("invariant")
    there.reset((1.0 + far[0], -2.0 + far[1], 0.3), (0.1, 0.1, 0.05))
    records = [
        drive_likelihood(each, events(), NOISE[None], keep_beliefs=True)
        for each in (slam, there)
    ]
    near, found = records
    assert (found.log_likelihoods == near.log_likelihoods).all()
    moved = near.poses + np.array([*far, 0.0])
    np.testing.assert_allclose(found.poses, moved, rtol=0, atol=2 * rounding(far))


def single_reading(slam, copy, reading, i):
    """Return ν and S of one reading by itself, by a copy of a filter without a gate."""
    copy.load_state_dict(slam.state_dict())
    report = copy.update([reading], [i])
    return report.innovation.ravel(), report.innovation_covariance


def slow_twin(slam, copy, drive_events, gate):
    """Follow the drive by the filter's public calls."""
    log_likelihoods, poses, nis, rejected = [], [], [], 0
    for s in range(len(drive_events.first_motions) - 1):
        for k in range(*drive_events.first_motions[s : s + 2]):
            d, alpha, dt = drive_events.motions[k]
            slam.predict((d, alpha), dt)
        rows = slice(*drive_events.first_readings[s : s + 2])
        readings, ids = drive_events.readings[rows], drive_events.landmarks[rows]
        before = {
            i: single_reading(slam, copy, z, i)
            for z, i in zip(readings, ids, strict=True)
            if i in slam.landmark_ids and z[1] > 1e-3
        }
        report = slam.update(readings, ids)
        total = density(report)
        for i in report.rejected_ids:
            _, S = before[i]
            total -= 0.5 * (gate + np.linalg.slogdet(2 * np.pi * S)[1])
        log_likelihoods.append(total)
        poses.append(slam.belief().pose)
        nis.append(report.nis)
        rejected += len(report.rejected_ids)
    return np.array(log_likelihoods), np.array(poses), np.array(nis), rejected


@pytest.mark.parametrize("gate", [np.inf, GATE])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("ekf", {}),
        ("invariant", {}),
        ("invariant", {"iterations": 1}),
        ("invariant", {"range_noise_at": "reading"}),
        ("first_estimates", {"noise_at_rest": False}),
        ("observability_constrained", {}),
        ("ekf", {"motion": OMNI, "noise_at_rest": False}),
    ],
)
def test_one_call_equals_the_public_calls_of_the_filter(name, options, gate):
    gated = {} if gate == np.inf else {"gate_probability": GATE_PROBABILITY}
    twin = filter_of(name, **options, **gated)
    expected, poses, nis, rejected = slow_twin(
        twin, filter_of(name, **options), events(), gate
    )
    other = filter_of(name, 2 * NOISE, **options)  # only its rules and start count
    record = drive_likelihood(other, events(), [NOISE], gate=gate, keep_beliefs=True)
    np.testing.assert_allclose(record.log_likelihoods[0], expected, rtol=1e-10)
    np.testing.assert_allclose(record.poses[0], poses, rtol=0, atol=1e-12)
    np.testing.assert_allclose(record.nis[0], nis, rtol=1e-10, atol=1e-12)
    assert record.rejected[0] == rejected
    assert (rejected > 0) == (gate < np.inf)


def test_a_batch_equals_single_calls_to_the_bit():
    noises = NOISE * np.array([0.5, 1.0, 1.7])[:, None]
    slam = filter_of("invariant")
    together = drive_likelihood(slam, events(), noises, keep_beliefs=True, threads=2)
    for b, noise in enumerate(noises):
        alone = drive_likelihood(slam, events(), [noise], keep_beliefs=True)
        for array, one in zip(together, alone, strict=True):
            assert array[b].tobytes() == one[0].tobytes()


def test_the_innovation_of_each_reading_is_noted_by_itself():
    slam, data = filter_of("ekf"), events()
    record = drive_likelihood(slam, data, [NOISE], keep_beliefs=True)
    row = int(np.flatnonzero(record.outcomes[0] == 0)[0])
    step = int(np.searchsorted(data.first_readings, row, side="right")) - 1
    slow_twin(slam, filter_of("ekf"), head(data, step), np.inf)
    for k in range(*data.first_motions[step : step + 2]):
        slam.predict(data.motions[k, :2], data.motions[k, 2])
    nu, S = single_reading(
        slam, filter_of("ekf"), data.readings[row], data.landmarks[row]
    )
    expected = nu / np.sqrt(np.diag(S))
    np.testing.assert_allclose(record.innovations[0, row], expected, rtol=1e-10)
    is_new = record.outcomes[0] == ADDED
    assert np.isnan(record.innovations[0, is_new]).all()
    assert {*record.outcomes[0]} == {0, ADDED, SKIPPED}


def head(data, steps):
    """Return the first steps of a drive."""
    motions, readings = data.first_motions[steps], data.first_readings[steps]
    return DriveEvents(
        data.motions[:motions],
        data.first_motions[: steps + 1],
        data.readings[:readings],
        data.landmarks[:readings],
        data.first_readings[: steps + 1],
    )


def test_a_rejected_reading_costs_no_more_than_at_the_gate():
    data = events()
    data.readings[-1, 1] += 3.0
    far = data._replace(readings=data.readings.copy())
    far.readings[-1, 1] += 30.0
    slam = filter_of("invariant")
    near, beyond = (
        drive_likelihood(slam, d, [NOISE], gate=30.0, keep_beliefs=True)
        for d in (data, far)
    )
    assert near.outcomes[0, -1] == GATED
    assert near.log_likelihoods.sum() == beyond.log_likelihoods.sum()


def test_a_pass_that_fails_is_impossible_from_there_and_the_others_go_on():
    nothing = np.zeros(7)
    data = events()
    slam = make_estimator("ekf", motion_std=(0, 0, 0), measurement_std=(0, 0))
    record = drive_likelihood(slam, data, [nothing, NOISE])
    assert record.log_likelihoods[0].sum() == -np.inf
    assert np.isfinite(record.log_likelihoods[1]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"readings": np.full((3, 2), np.nan)}, "readings must be finite"),
        ({"motions": np.full((2, 3), 1e13)}, "motions must be finite numbers, at most"),
        ({"motions": np.zeros((2, 2))}, "motions must have 3 columns"),
        ({"first_motions": np.array([0, 2, 1])}, "first_motions must rise from 0 to"),
        ({"landmarks": np.array([0])}, "landmarks must have one entry"),
    ],
)
def test_events_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        drive_likelihood(filter_of("ekf"), events()._replace(**change), [NOISE])


def test_a_filter_off_the_shared_kernels_is_refused():
    slam = UnscentedSlam(motion_std=MOTION_STD, measurement_std=MEASUREMENT_STD)
    with pytest.raises(ValueError, match="shared kernels"):
        drive_likelihood(slam, events(), [NOISE])


def test_another_sensor_is_refused_by_the_name_of_the_command():
    noise = {"motion_std": MOTION_STD, "measurement_std": MEASUREMENT_STD}
    slam = make_estimator("ekf", **noise, sensor="position")
    with pytest.raises(ValueError, match=r"^fit-noise .* accepts only sensor"):
        drive_likelihood(slam, events(), [NOISE])
