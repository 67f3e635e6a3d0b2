"""The noise of a world by its truth, and the cause that it points to."""

import re
from itertools import product

import numpy as np
import pytest
from scipy import stats

from slamgym.estimator.models.sensors import BEARING_RANGE
from slamgym.evaluation import CAUSES, SmallNoise, diagnose
from slamgym.evaluation.diagnosis import (
    _change,
    _exceeds,
    _is_positive,
    _is_small,
    _larger,
    _rest_of,
    blame_association,
    diverged_runs,
    errors_of,
    excess_of,
    p_text,
    runs_to_repeat,
    spurious_knowledge,
)
from slamgym.evaluation.hypothesis_tests import time_average_test
from slamgym.evaluation.noise_findings import (
    CHANNELS,
    MOMENTS,
    noise_findings,
    noise_sums,
)

RUNS, STEPS = 60, 40
MOTION_STD, SENSOR_STD = (0.2, 0.1, 0.05), (0.02, 0.1)
PER_METRE = 0.03


def drive(rng, *, runs=3, steps=6, landmarks=4, noise_in="motion"):
    """A drive with known noise, step by step; the slow twin of the sums."""
    poses, points = np.zeros((runs, steps, 3)), rng.uniform(-5, 5, (runs, landmarks, 2))
    poses[:, 0] = rng.uniform(-4, 4, (runs, 3))
    command = rng.uniform((0.2, -1.0), (2.0, 1.0), (runs, steps, 2))
    motion = rng.normal(size=(runs, steps, 3)) * MOTION_STD
    odometry, visible = command.copy(), rng.random((runs, steps, landmarks)) < 0.7
    if noise_in == "odometry":
        motion[..., 1] = 0.0
        odometry -= motion[..., ::2]
    sensor = rng.normal(size=(runs, steps, landmarks, 2))
    readings = np.zeros(sensor.shape)
    for b in range(runs):
        for t in range(steps):
            if t:
                x, y, theta = poses[b, t - 1]
                slip = motion[b, t] if noise_in == "motion" else np.zeros(3)
                ahead, left = command[b, t, 0] + slip[0], slip[1]
                poses[b, t] = (
                    x + ahead * np.cos(theta) - left * np.sin(theta),
                    y + ahead * np.sin(theta) + left * np.cos(theta),
                    theta + command[b, t, 1] + slip[2],
                )
            for i in range(landmarks):
                dx, dy = points[b, i] - poses[b, t, :2]
                far = np.hypot(dx, dy)
                sensor[b, t, i] *= SENSOR_STD[0], SENSOR_STD[1] + PER_METRE * far
                readings[b, t, i] = np.arctan2(dy, dx) - poses[b, t, 2], far
    readings += sensor
    return poses, points, odometry, readings, visible, motion, sensor, command


def summed(poses, points, odometry, readings, visible, **options):
    return noise_sums(
        poses, points, odometry, readings, visible, motion_std=MOTION_STD,
        measurement_std=SENSOR_STD,
        sensor=BEARING_RANGE.with_noise(range_std_per_metre=PER_METRE), **options,
    )  # fmt: skip


@pytest.mark.parametrize("noise_in", ["motion", "odometry"])
def test_sums_are_those_of_the_noise_that_made_the_drive(noise_in):
    *data, motion, sensor, command = drive(np.random.default_rng(1), noise_in=noise_in)
    sums = summed(*data, noise_in=noise_in)
    poses, points, _, _, visible = data
    far = np.linalg.norm(points[:, None] - poses[:, :, None, :2], axis=-1)
    for b in range(len(poses)):
        w = list((motion[b, 1:] / MOTION_STD).T)
        seen = sensor[b, visible[b]] / SENSOR_STD[0]
        range_std = SENSOR_STD[1] + PER_METRE * far[b][visible[b]]
        w += [seen[:, 0], sensor[b, visible[b]][:, 1] / range_std]
        for channel, values in zip(sums[b], w, strict=True):
            powers = [(values**k).sum() for k in range(5)]
            assert channel[:5] == pytest.approx(powers, abs=1e-9)
        stds = [*MOTION_STD, SENSOR_STD[0], range_std]
        for k, values in enumerate(w):
            g = (1 if k else command[b, 1:, 0]) / (stds[k] + 0 * values)
            expected = (g * values).sum(), (g * g).sum()
            assert sums[b, k, 5:7] == pytest.approx(expected)
        for channel, values in zip(sums[b], w[:3], strict=False):
            lagged = (values[1:] * values[:-1]).sum()
            assert channel[7:9] == pytest.approx([len(values) - 1, lagged], abs=1e-9)
            assert not channel[9:].any()
        both = visible[b, 1:] & visible[b, :-1]
        for k, std in enumerate((SENSOR_STD[0], SENSOR_STD[1] + PER_METRE * far[b])):
            noise = sensor[b, ..., k] / std
            lagged = (noise[1:] * noise[:-1])[both].sum()
            assert sums[b, 3 + k, 7:9] == pytest.approx([both.sum(), lagged])
            r, w = far[b][visible[b]], noise[visible[b]]
            of_distance = r.sum(), (r**2).sum(), (r * w**2).sum()
            assert sums[b, 3 + k, 9:] == pytest.approx(of_distance)


def test_sums_do_not_depend_on_full_turns_nor_on_other_runs():
    data = list(drive(np.random.default_rng(4), landmarks=1)[:5])
    counted = np.ones((3, 6), dtype=bool)
    for k, steps in enumerate((counted, data[4])):  # the second run follows the first
        steps[0, 3:], steps[1, : 3 + k], steps[2, 4] = False, False, False
    sums = summed(*data, noisy_steps=counted)
    for b in range(3):
        alone = [each[b : b + 1] for each in (*data, counted)]
        one = summed(*alone[:-1], noisy_steps=alone[-1])
        np.testing.assert_array_equal(one[0], sums[b])
    aside = np.full(counted.shape, 0.02)
    data[2] = np.insert(data[2], 1, aside, axis=2)
    data[0][:, ::2, 2] += 2 * np.pi
    data[3][..., 0] -= 2 * np.pi
    turned = summed(*data, noisy_steps=counted)
    change = np.zeros_like(sums)
    change[:, 1, 1] = -(aside / MOTION_STD[1] * counted)[:, 1:].sum(axis=1)
    at = np.arange(5) != 1
    np.testing.assert_allclose(turned[:, at], sums[:, at], atol=1e-9)
    np.testing.assert_allclose((turned - sums)[:, 1, :2], change[:, 1, :2], atol=1e-9)


def test_steps_that_do_not_count_are_left_out_of_the_motion_alone():
    data = drive(np.random.default_rng(2))[:5]
    counted = np.zeros((3, 6), dtype=bool)
    counted[:, 3] = True
    sums = summed(*data, noisy_steps=counted)
    assert sums.shape == (3, len(CHANNELS), len(MOMENTS))
    assert (sums[:, :3, 0] == 1).all()
    assert sums[:, 3:, 0].tolist() == summed(*data)[:, 3:, 0].tolist()


def test_a_reading_from_the_place_of_its_landmark_is_counted():
    poses, points, *rest = drive(np.random.default_rng(3))[:5]
    points[0, 0] = poses[0, 2, :2]
    assert np.isfinite(summed(poses, points, *rest)).all()


def test_a_noise_that_is_not_assumed_and_not_there_is_no_channel():
    data = drive(np.random.default_rng(3), noise_in="odometry")[:5]
    options = {"measurement_std": SENSOR_STD, "motion_std": (0.2, 0.0, 0.05)}
    assert not noise_sums(*data, **options)[:, 1].any()
    slipping = drive(np.random.default_rng(3))[:5]
    assert noise_sums(*slipping, **options)[:, 1, 2].min() > 1e6


def sums_of(w, lever=20.0):
    """Sums of standardised noise, shape (runs, 5, numbers), all of one lever."""
    powers = [(w**k).sum(axis=2) for k in range(5)]
    count = np.full(w.shape[:2], w.shape[2])
    lagged = (w[:, :, 1:] * w[:, :, :-1]).sum(axis=2)
    terms = [*powers, lever * powers[1], lever**2 * count, count - 1, lagged]
    return np.stack(terms, axis=2)


def honest(seed, runs=RUNS):
    rng = np.random.default_rng(seed)
    return {
        "noise": sums_of(rng.standard_normal((runs, 5, STEPS))),
        "nees": rng.chisquare(3, (runs, STEPS)),
        "heading_nees": rng.chisquare(1, (runs, STEPS)),
    }


def with_noise(channel, change, seed=5):
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((RUNS, 5, STEPS))
    at = CHANNELS.index(channel)
    w[:, at] = change(rng, w[:, at])
    return honest(seed) | {"noise": sums_of(w)}


def in_time(w, phi=0.4):
    """Noise of the same size, correlated in time."""
    out = w.copy()
    for step in range(1, w.shape[-1]):
        out[:, step] = phi * out[:, step - 1] + np.sqrt(1 - phi**2) * w[:, step]
    return out


@pytest.mark.parametrize(
    ("channel", "change", "cause"),
    [
        ("along", lambda _, w: 1.15 * w, "motion noise too small"),
        ("sideways", lambda _, w: 0.85 * w, "motion noise too large"),
        ("turn", lambda _, w: 1.15 * w, "motion noise too small"),
        ("bearing", lambda _, w: 1.15 * w, "bearing noise too small"),
        ("bearing", lambda _, w: 0.85 * w, "bearing noise too large"),
        ("range", lambda _, w: 1.15 * w, "range noise too small"),
        ("range", lambda _, w: 0.85 * w, "range noise too large"),
        ("along", lambda _, w: w - 0.2, "odometry scale"),
        ("turn", lambda _, w: w + 0.2, "odometry turn"),
        ("bearing", lambda _, w: w + 0.2, "bearing bias"),
        ("range", lambda _, w: w - 0.2, "range bias"),
        ("turn", lambda _, w: in_time(w), "correlated noise"),
        ("bearing", lambda _, w: in_time(w), "correlated noise"),
        ("turn", lambda rng, w: rng.standard_t(5, w.shape), "heavy tails"),
        ("range", lambda rng, w: rng.standard_t(5, w.shape) / 1.29, "heavy tails"),
    ],
)
def test_each_fault_of_the_noise_is_named(channel, change, cause):
    found = diagnose(**with_noise(channel, change))
    assert found.cause == cause
    assert found.p_value < 0.025
    assert found.sentence.startswith(f"{cause}: ")
    assert "; the errors do not show it: the squared" in found.sentence
    assert found.cause in CAUSES


def test_a_fault_of_the_noise_is_named_if_its_p_value_is_below_two_percent():
    causes = set()
    for size in np.linspace(1.0, 1.1, 41):
        found = diagnose(**with_noise("along", lambda _, w, size=size: size * w))
        assert found.p_value < 0.02 or found.cause == "honest"
        causes.add(found.cause)
    assert causes == {"honest", "motion noise too small"}


def test_the_larger_of_two_faults_is_named_first():
    rng = np.random.default_rng(8)
    w = rng.standard_normal((RUNS, 5, STEPS))
    w[:, 3] *= 1.1
    w[:, 4] *= 1.4
    found = diagnose(**honest(8) | {"noise": sums_of(w)})
    assert found.cause == "range noise too small"
    assert found.others == ("bearing noise too small",)
    large = diagnose(**wrong(8, 3.2) | {"noise": sums_of(w)})  # twice 1.1², not 1.4²
    assert large.cause == "range noise too small"


def test_a_certain_but_tiny_fault_is_no_cause():
    rng = np.random.default_rng(9)
    w = 1.01 * rng.standard_normal((RUNS, 5, 1500))
    found = diagnose(**honest(9) | {"noise": sums_of(w)})
    assert found.cause == "honest"
    assert min(f.p_value for f in noise_findings(sums_of(w))) < 1e-6


def test_honest_runs_are_called_something_else_in_at_most_five_percent():
    causes = [diagnose(**honest(seed)).cause for seed in range(100, 140)]
    assert causes.count("honest") >= 36  # of 40; fewer in .3 % of cases at 5 %


@pytest.mark.parametrize("lost", [0, 3])
def test_a_filter_is_honest_as_long_as_its_tests_do_not_reject(lost):
    seen = set()
    for factor in np.linspace(0.7, 1.4, 36):
        scores = wrong(14, factor) | {"noise": None}
        scores["nees"][[3, 30, 50][:lost]] += 22
        errors = errors_of(scores["nees"], scores["heading_nees"])
        found = diagnose(**scores)
        assert (found.cause == "honest") == (errors.p_value >= 0.02)
        assert found.p_value == errors.p_value <= 1
        found = diagnose(**scores, rejected=True)
        is_near = 1 / 1.1 < errors.ratio < 1.1
        shown = (errors.p_value < 0.02) or (errors.p_of_one < 0.02 and not is_near)
        assert ("a test rejects the filter, although" in found.sentence) != shown
        seen.add((errors.p_value < 0.02, shown, is_near))
    assert len(seen) > 1


def wrong(seed, factor=1.8, **options):
    """The scores of a filter whose squared errors are too large by a factor."""
    scores = honest(seed, **options)
    return scores | {"nees": factor * scores["nees"]}


def less_noise(scores, excess, factor=0.1, runs=RUNS):
    """The runs of a filter again, the excess of whose squared errors is another."""
    average = scores["nees"].mean(axis=1)
    ratio = average.mean() / 3
    again = average * (1 + excess * (ratio - 1)) / ratio
    again[runs:] = np.nan
    heading = np.where(np.isnan(again), np.nan, scores["heading_nees"].mean(axis=1))
    return SmallNoise(again, heading, factor)


@pytest.mark.parametrize("factor", [1.3, 1.8, 40.0])
@pytest.mark.parametrize(
    ("excess", "cause", "text"),
    [
        (0.001, "linearisation", "vanishes with the noise"),
        (1.0, "wrong covariance", "so the excess stays"),
        (100.0, "wrong model", "do not shrink with it"),
    ],
)
def test_what_is_left_of_an_excess_with_less_noise_names_the_cause(
    factor, excess, cause, text
):
    scores = wrong(11, factor, runs=120)
    without = diagnose(**scores)
    assert without.cause == "cannot tell"
    assert "a tenth of the noise would show it" in without.sentence
    count = without.repeat
    assert count == 12 if factor == 40 else 12 <= count <= 120
    found = diagnose(**scores, small_noise=less_noise(scores, excess, runs=count))
    assert found.cause == cause
    assert found.sentence.startswith(f"{cause}: the noise is as assumed, but the sq")
    assert text in found.sentence
    assert (found.repeat == 0) == (cause == "linearisation")  # the others: once more
    last = less_noise(scores, excess**2, factor=0.01)
    found = diagnose(**scores, small_noise=last)
    assert (found.cause, found.repeat) == (cause, 0)


def test_a_run_that_diverges_with_less_noise_too_is_not_the_average_of_all():
    scores = wrong(11, 3.0)
    small = less_noise(scores, 0.001, factor=0.01)
    small.nees[0] = 3e7
    found = diagnose(**scores, small_noise=small)
    assert found.cause == "linearisation"
    assert "but for 1 diverged run," in found.sentence
    small.nees[:7] = 3e7
    assert diagnose(**scores, small_noise=small).cause != "linearisation"


def test_an_excess_of_which_a_part_remains_is_repeated_with_still_less_noise():
    scores = wrong(11, 4.0)
    found = diagnose(**scores, small_noise=less_noise(scores, 0.2))
    assert (found.cause, found.repeat > 0) == ("cannot tell", True)
    last = diagnose(**scores, small_noise=less_noise(scores, 0.2, factor=0.01))
    assert last.cause == "wrong covariance"
    assert "With 1 % of the noise" in last.sentence
    assert "so some of the excess stays" in last.sentence


def test_an_excess_that_may_be_chance_is_no_wrong_covariance():
    scores = honest(14, runs=30)
    scores["nees"] *= np.random.default_rng(2).gamma(4, 1.3 / 4, (30, 1))
    tested = errors_of(scores["nees"], scores["heading_nees"])
    assert tested.p_value > 0.02 > tested.p_of_one
    small = less_noise(scores, 1.0, runs=30)
    found = diagnose(**scores, small_noise=small, rejected=True)
    assert found.cause == "cannot tell"
    assert found.sentence.endswith("may be chance: try another seed.")


def test_an_excess_that_remains_in_the_pose_alone_does_not_vanish():
    scores = wrong(11, 3.0)
    scores["heading_nees"] *= 8.0
    small = less_noise(scores, 1.0, factor=0.01)
    few = small._replace(heading_nees=small.heading_nees / 8)
    found = diagnose(**scores, small_noise=few)
    assert "the squared errors of the heading are 8" in found.sentence
    assert found.cause == "wrong covariance"
    assert "With 1 % of the noise, the squared errors of the pose are 3" in (
        found.sentence
    )
    few = few._replace(nees=few.nees / 3)
    assert diagnose(**scores, small_noise=few).cause == "linearisation"


def test_a_cautious_heading_does_not_hide_an_excess_that_remains():
    scores = wrong(11, 25.0)
    small = less_noise(scores, 0.75 / 24, factor=0.01)
    small = small._replace(heading_nees=0.5 * small.heading_nees)
    found = diagnose(**scores, small_noise=small)
    assert found.cause == "wrong covariance"
    assert "the squared errors of the pose are 1.7" in found.sentence


def test_an_excess_with_very_large_innovations_is_not_of_the_linearisation():
    scores = wrong(11, 40.0)
    small = less_noise(scores, 0.001)
    most = np.sqrt(errors_of(scores["nees"], scores["heading_nees"]).ratio)
    found = diagnose(**scores, small_noise=small, nis_ratio=most)
    assert found.cause == "linearisation"
    found = diagnose(**scores, small_noise=small, nis_ratio=np.nextafter(most, 9))
    assert found.cause == "cannot tell"
    assert found.sentence.endswith("is an angle not wrapped?")


def test_few_runs_with_large_errors_do_not_show_that_an_excess_vanishes():
    scores, rng = wrong(11, 200.0), np.random.default_rng(3)
    after = np.where(np.arange(RUNS) < 10, 30 * rng.exponential(1.0, RUNS), np.nan)
    small = SmallNoise(after, after / 30, 0.01)
    found = diagnose(**scores, small_noise=small)
    assert found.cause == "wrong covariance"
    few = small._replace(nees=np.where(np.arange(RUNS) < 10, 3 + after / 20, np.nan))
    assert diagnose(**scores, small_noise=few).cause == "cannot tell"


@pytest.mark.parametrize(
    ("excess", "cause"), [(1.1, "wrong covariance"), (100.0, "wrong model")]
)
def test_an_excess_that_grows_because_a_filter_diverges_is_compared_twice(
    excess, cause
):
    scores = wrong(11, 20.0)
    larger = less_noise(scores, 12.0)
    small = less_noise(scores, 12.0 * excess, factor=0.01)._replace(larger=larger)
    found = diagnose(**scores, small_noise=small)
    assert (found.cause, found.repeat) == (cause, 0)


@pytest.mark.parametrize(
    ("shrunk", "cause"),
    [(0.1, "wrong covariance"), (0.4, "wrong model"), (1.0, "wrong model")],
)
def test_errors_that_shrink_with_the_noise_are_of_no_wrong_model(shrunk, cause):
    scores, error = wrong(11, 20.0), np.linspace(0.1, 0.2, RUNS)
    larger = less_noise(scores, 100.0)._replace(position_error=error)
    small = less_noise(scores, 10000.0, factor=0.01)
    small = small._replace(larger=larger, position_error=shrunk * error)
    error[:2], small.position_error[2] = (0.0, np.nan), np.nan  # do not count
    found = diagnose(**scores, small_noise=small)
    assert (found.cause, found.repeat) == (cause, 0)
    assert ("shrink to 0.1 times" in found.sentence) == (cause == "wrong covariance")


def test_an_average_that_may_be_one_has_no_cause():
    scores = honest(14)
    scores["nees"][::6] *= 1.8
    small = less_noise(scores, 0.0)
    shaken = scores | {
        "nees": scores["nees"] * np.random.default_rng(4).gamma(1, 1, (RUNS, 1))
    }
    tested = errors_of(shaken["nees"], shaken["heading_nees"])
    assert (tested.ratio > 1.1, tested.p_of_one > 0.02) == (True, True)
    found = diagnose(**shaken, small_noise=small, rejected=True)
    assert found.cause == "cannot tell"
    assert "although on average" in found.sentence


def test_noise_that_makes_errors_smaller_is_no_cause_of_large_ones():
    rng = np.random.default_rng(8)
    w = rng.standard_normal((RUNS, 5, STEPS))
    w[:, 0] *= 0.44
    scores = wrong(8, 1.7) | {"noise": sums_of(w)}
    found = diagnose(**scores)
    assert (found.cause, found.others) == ("cannot tell", ("motion noise too large",))
    assert "which makes errors smaller than stated" in found.sentence
    w[:, 2] *= 1.35
    found = diagnose(**scores | {"noise": sums_of(w)})
    assert found.cause == "motion noise too small"
    assert found.others == ("motion noise too large",)
    small = wrong(8, 0.6) | {"noise": sums_of(w)}
    assert diagnose(**small).cause == "motion noise too large"
    w[:, 0] /= 0.44
    found = diagnose(**small | {"noise": sums_of(w)})
    assert (found.cause, found.others) == ("cannot tell", ("motion noise too small",))
    assert "which makes errors larger than stated" in found.sentence


def test_slightly_wrong_noise_is_no_cause_of_huge_errors():
    rng = np.random.default_rng(8)
    w = 1.1 * rng.standard_normal((RUNS, 5, STEPS))
    scores = wrong(8, 3.2) | {"noise": sums_of(w)}
    found = diagnose(**scores)
    assert found.cause == "cannot tell"
    assert "which explains at most 1.2" in found.sentence
    left = less_noise(scores, 0.2 / 2.2)  # that of the noise
    assert diagnose(**scores, small_noise=left).cause == "linearisation"


def test_a_cautious_filter_has_a_cause_too():
    scores = wrong(13, 0.5)
    assert diagnose(**scores).cause == "cannot tell"
    for excess, cause in ((0.0, "linearisation"), (1.0, "wrong covariance")):
        small = less_noise(scores, excess)
        assert diagnose(**scores, small_noise=small).cause == cause
    found = diagnose(**scores, small_noise=less_noise(scores, 0.0), nis_ratio=1.2)
    assert found.sentence.endswith("is an angle not wrapped?")


def test_nothing_is_concluded_if_the_runs_fail_with_less_noise():
    scores = wrong(11)
    small = SmallNoise(np.full(RUNS, np.nan), np.full(RUNS, np.nan))
    found = diagnose(**scores, small_noise=small)
    assert found.cause == "cannot tell"
    assert "Too few runs succeed with less noise" in found.sentence
    for known in (4, 5):
        text = diagnose(
            **scores, small_noise=less_noise(scores, 1, runs=known)
        ).sentence
        assert ("Too few runs succeed" in text) == (known < 5)


def test_without_the_noise_only_the_errors_are_judged():
    scores = honest(14) | {"noise": None}
    assert diagnose(**scores).sentence.startswith("honest: the errors agree")
    found = diagnose(**wrong(11) | {"noise": None})
    assert found.sentence.startswith("cannot tell: the squared errors of the pose are")


def test_innovations_do_not_contradict_errors_that_agree():
    scores = honest(14)
    assert "innovations" not in diagnose(**scores, nis_ratio=1.15).sentence
    found = diagnose(**scores, nis_ratio=5.27)
    assert found.cause == "honest"
    assert "the reported squared innovations are 5.27 times what" in found.sentence


def test_spurious_knowledge_of_the_heading_makes_small_errors_suffice():
    scores = honest(12)
    nearly = scores | {"heading_nees": 1.15 * scores["heading_nees"]}
    assert diagnose(**nearly, heading_knowledge=np.ones(RUNS)).cause == "honest"
    knowing = diagnose(**nearly, heading_knowledge=np.full(RUNS, 0.6))
    assert knowing.cause == "cannot tell"
    assert "reports 60 % of the smallest heading variance" in knowing.sentence
    agreeing = diagnose(**scores, heading_knowledge=np.full(RUNS, 0.6))
    assert (agreeing.cause, agreeing.repeat) == ("cannot tell", 0)
    figures = re.findall(r"\(p . ([^)]*)\)", agreeing.sentence)
    assert float(figures[0]) < 1e-9  # of the knowledge
    assert float(figures[1]) > 0.02  # of the errors


def test_runs_with_wrong_associations_that_err_more_point_to_the_association():
    scores, mistakes = honest(14), np.zeros(RUNS)
    nees = scores["nees"].copy()
    nees[:20] *= np.linspace(1, 7, STEPS)
    mistakes[:20] = 3
    larger = scores | {"nees": nees}
    found = diagnose(**larger, mistakes=mistakes)
    assert found.cause == "association"
    assert found.p_value == blame_association(nees, mistakes, None).p_value
    smaller = scores | {"nees": nees / 4}
    assert diagnose(**smaller, mistakes=mistakes).repeat > 0  # errors are too small
    other = diagnose(**larger, mistakes=mistakes[::-1])
    assert (other.cause, other.repeat) == ("cannot tell", 0)
    assert "err no more than others" in other.sentence
    assert diagnose(**larger, mistakes=np.zeros(RUNS)).repeat > 0


def test_errors_that_known_identities_remove_are_of_the_association():
    scores, mistakes = honest(17), np.ones(RUNS)
    nees = scores["nees"]
    known = nees / np.linspace(1.0, 1.6, RUNS)[:, None]
    found = diagnose(**scores, mistakes=mistakes, known_nees=known)
    assert found.cause == "association"  # though all its errors together are honest
    assert "with known identities" in found.sentence
    early = (0, 0), (2, 0)  # two steps without a NEES
    late = {
        key: np.pad(scores[key], early, constant_values=np.nan)
        for key in ("nees", "heading_nees")
    }
    wide = np.pad(known, early, constant_values=1e6)
    assert diagnose(**scores | late, mistakes=mistakes, known_nees=wide) == found
    assert diagnose(**scores, known_nees=known).cause == "honest"  # none is wrong
    slightly = nees / np.linspace(1.0, 1.1, RUNS)[:, None]
    close = diagnose(**scores, mistakes=mistakes, known_nees=slightly)
    assert close.cause == "honest"


def test_errors_that_known_identities_share_are_not_of_the_association():
    scores, rng = honest(18), np.random.default_rng(18)
    nees = np.linspace(1, 2.6, STEPS) * scores["nees"]
    nees[3] = 60.0
    known = nees * rng.uniform(0.8, 1.25, nees.shape)
    both = scores | {"nees": nees, "mistakes": np.ones(RUNS), "known_nees": known}
    assert diagnose(**both).repeat > 0
    growth = np.linspace(1, 800, STEPS)
    more = {"nees": growth * nees, "known_nees": growth * known / 1.05}
    assert diagnose(**both | more).repeat > 0  # a tenth of them
    nees[[5, 7]] = 60.0
    assert diagnose(**both | {"nees": nees}).cause == "association"
    with pytest.raises(ValueError, match="known_nees must have shape"):
        diagnose(**both | {"known_nees": known[:, 1:]})


def test_a_few_diverged_runs_are_not_called_honest():
    scores, mistakes = honest(16), np.ones(RUNS)
    nees = scores["nees"].copy()
    nees[[3, 30, 50]] = nees[[3, 30, 50]] * [[60.0], [400.0], [15.0]]
    mistakes[[3, 30, 50]] = 5
    lost = scores | {"nees": nees}
    assert "and 3 runs diverged" in diagnose(**lost).sentence
    count = diagnose(**lost).repeat
    assert count == 51  # with all three
    for left, cause in ((0.0, "linearisation"), (1.0, "wrong covariance")):
        again = np.where(np.arange(RUNS) < count, nees.mean(axis=1), np.nan)
        again[[3, 30, 50]] = 3 + left * (again[[3, 30, 50]] - 3)
        small = SmallNoise(again, scores["heading_nees"].mean(axis=1))
        assert diagnose(**lost, small_noise=small).cause == cause
    assert diagnose(**lost, mistakes=mistakes).cause == "association"
    assert diagnose(**lost, mistakes=6 - mistakes).cause == "cannot tell"
    nees[[3, 50]] = scores["nees"][[3, 50]]
    assert diagnose(**lost | {"nees": nees}).cause == "honest"  # one is chance


def test_a_heading_known_for_certain_has_no_part_in_the_answer():
    certain = honest(15) | {"heading_nees": np.full((RUNS, STEPS), np.nan)}
    assert diagnose(**certain).cause == "honest"
    certain["nees"], ones = 3 * certain["nees"], np.ones(RUNS)
    for after in (ones, np.full(RUNS, np.nan)):
        small = SmallNoise(3 * ones, after, 0.01)
        assert diagnose(**certain, small_noise=small).cause == "linearisation"
    both = certain | {"heading_nees": honest(15)["heading_nees"]}
    assert diagnose(**both, small_noise=small).cause == "linearisation"


def test_steps_at_which_a_run_knows_its_heading_for_certain_are_left_out():
    scores = honest(15)
    heading = scores["heading_nees"].copy()
    heading[:, 5:] = 40.0
    heading[3, 5], heading[7, 6:] = np.nan, np.nan
    assert diagnose(**scores | {"heading_nees": heading}).cause == "honest"


def test_few_runs_decide_nothing():
    found = diagnose(**honest(0, runs=19))
    assert (found.cause, found.p_value) == ("cannot tell", 1.0)
    assert "19 runs" in found.sentence
    assert diagnose(**honest(0, runs=20)).cause == "honest"


def test_innovations_are_named_if_they_are_too_large_by_more_than_a_seventh():
    said = "; the squared innovations are 1.16 times too large. "
    assert said in diagnose(**wrong(11), nis_ratio=1.16).sentence
    assert "innovations" not in diagnose(**wrong(11), nis_ratio=1.15).sentence


def test_leading_steps_without_nees_do_not_count():
    scores = wrong(11)
    early = ((0, 0), (3, 0))
    for name in ("nees", "heading_nees"):
        scores[f"{name}"] = np.pad(scores[name], early, constant_values=np.nan)
    scores["nees"][0, 2] = 3.0  # of one run alone
    assert diagnose(**scores) == diagnose(**wrong(11))
    last = {name: scores[name][:, -1:] for name in ("nees", "heading_nees")}
    assert diagnose(None, **last).sentence.startswith("cannot tell: the squared errors")
    last["nees"][0] = np.nan
    with pytest.raises(ValueError, match="nees must be finite"):
        diagnose(None, **last)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("noise", np.zeros((RUNS, 5, 6)), r"noise must have shape \(60, 5, 12\)"),
        ("noise", np.full((RUNS, 5, 9), np.nan), "noise must be finite"),
        (
            "noise",
            np.where(np.arange(9), np.ones((RUNS, 5, 9)), np.nan),
            "noise must be",
        ),
        ("nees", np.where(np.eye(RUNS, STEPS, 3), np.nan, 3), "nees must be finite"),
        ("nees", np.ones((RUNS, 0)), r"^nees must have shape"),
        ("nees", np.ones(RUNS), r"nees must have shape \(runs, steps\)"),
        ("nees", np.full((RUNS, STEPS), np.nan), "nees must be finite"),
        ("heading_nees", np.ones((RUNS, 2)), "heading_nees must have shape"),
    ],
)
def test_bad_input_is_refused_by_name(name, value, message):
    with pytest.raises(ValueError, match=message):
        diagnose(**honest(0) | {name: value})


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (0, r"true_poses must have shape \(B, T, 3\)"),
        (2, "odometry must have shape"),
        (3, "measurements must have shape"),
        (4, "visible must have"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(place, message):
    data = list(drive(np.random.default_rng(0))[:5])
    data[place] = data[place][:, :, :2] if place == 0 else data[place][:, :4]
    with pytest.raises(ValueError, match=message):
        summed(*data)


# ---- the parts of a diagnosis, compared with scipy and with examples by hand


def test_p_values_of_errors_come_from_averages_and_from_diverged_runs():
    rng = np.random.default_rng(20)
    for of_pose, of_heading, lost in [
        *((1.3, 1.2, 0), (0.7, 1.05, 0), (1.05, 0.6, 0), (1.0, 1.5, 2)),
        *((1.05, 1.0, 3), (1.6, 0.0, 0), (1.05, 1.0, 1), *[(1.0, 1.0, 0)] * 9),
    ]:
        pose = of_pose * rng.chisquare(3, (40, 15))
        pose[:lost] += 30
        heading = of_heading * rng.chisquare(1, (40, 9))[:, : 9 * (of_heading > 0)]
        scores = (pose / 3, heading) if of_heading else (pose / 3,)
        averages = [score.mean(axis=1) for score in scores]
        p_values = [stats.binom.sf(lost - 1, 40, 1e-3)]
        for each in averages:
            margin = np.clip(each.mean(), 1 / 1.1, 1.1)
            beyond = time_average_test(each / margin, 1).p_value
            p_values.append(1.0 if margin == each.mean() else beyond)
        found = errors_of(pose, heading)
        assert found.p_value == pytest.approx(min(1, len(p_values) * min(p_values)))
        assert found.diverged == lost
        ratios = [each.mean() for each in averages]
        far = int(np.argmax(np.abs(np.log(ratios))))
        assert found.of == ("pose", "heading")[far]
        assert found.ratio == pytest.approx(ratios[far])
        plain = min(time_average_test(each, 1).p_value for each in averages)
        assert found.p_of_one == pytest.approx(min(1, len(averages) * plain))
        assert (f", and {lost} runs diverged" in found.text) == (lost > 1)


def test_a_run_diverges_beyond_the_quantile_of_one_nees():
    edge = stats.chi2.isf(1e-4, 3)
    pose = edge + np.array([[-1, 1 - 1e-9], [0, 0], [-1, 1 + 1e-9]])
    assert diverged_runs(pose).tolist() == [False, False, True]


def test_p_values_are_written_with_two_digits():
    texts = [p_text(p) for p in (9.9e-17, 1e-16, 0.0123)]
    assert texts == ["p < 1e-16", "p = 1e-16", "p = 0.012"]


def steady(ratios, degrees=3):
    """Return NEES of two steps with the given averages per degree of freedom."""
    return np.repeat(degrees * np.asarray(ratios)[:, None], 2, axis=1)


WIDE = np.tile([0.5, 2.5], 100)


@pytest.mark.parametrize(
    ("ratios", "lost", "count"),
    [
        (np.full(200, 2.01), (), 20),  # most err clearly: a tenth of the runs
        (np.full(60, 2.01), (), 10),
        (WIDE, (), 49),  # (3.5 × 1 / 0.5)²
        (np.tile([0.5, 1.5], 300), (), 307),  # (3.5 × 0.5 / 0.1)²
        (np.tile([0.5, 1.5], 100), (), 200),
        (np.tile([1.4, 1.6], 100), (), 20),  # (3.5 × 0.1 / 0.5)² is less
        (np.tile([0.0, 2.0, 4.0], 66), (), 33),  # (3.5 × 1.63 / 1)²
        (np.tile([0.0, 1.4], 100), (), 67),  # (3.5 × 0.7 / 0.3)²
        (np.ones(200), (150,), 200),
        (np.ones(200), (3, 90), 91),
        (np.ones(200), (3, 40, 50, 60, 70, 80), 71),  # the first five
        (np.ones(200), (3, 4), 20),
    ],
)
def test_as_many_runs_are_repeated_as_show_half_of_the_excess(ratios, lost, count):
    ratios = np.where(np.isin(np.arange(len(ratios)), lost), 30.0, ratios)
    still = np.ones((len(ratios), 1))
    assert runs_to_repeat(steady(ratios), still) == count
    if ratios.mean() != 1 and not lost:
        assert runs_to_repeat(3 * still, steady(ratios, 1)) == count


@pytest.mark.parametrize(
    ("after", "known", "factor", "cause", "count"),
    [
        ([0.1, 2.1], 100, 0.1, "cannot tell", 144),  # (3 × 1 / 0.25)²
        ([0.1, 2.1], 100, 0.01, "cannot tell", 144),
        ([0.1, 2.1], 144, 0.01, "cannot tell", 0),
        ([0.1, 2.1], 100, 0.02, "wrong covariance", 144),
        ([0.1, 2.1], 100, 0.01, "wrong covariance", 0),
        ([0.1, 2.1], 100, 0.1, "linearisation", 0),
        ([0.1, 2.1], 4, 0.1, "cannot tell", 49),  # too few to know the deviation
        ([0.1, 2.1], 5, 0.1, "cannot tell", 139),
        ([2.0, 4.0, 0.0], 99, 0.1, "cannot tell", 49),  # it seems to stay
        ([0.9, 1.3], 48, 0.01, "cannot tell", 49),
        ([0.9, 1.3], 49, 0.01, "cannot tell", 0),
    ],
)
def test_more_runs_are_repeated_where_the_repeated_ones_show_too_little(
    after, known, factor, cause, count
):
    found = np.resize(np.array(after), 200)
    found[known:] = np.nan
    still, one = np.ones((200, 1)), np.where(np.isfinite(found), 1.0, np.nan)
    small = SmallNoise(3 * found, one, factor)
    assert runs_to_repeat(steady(WIDE), still, small, cause) == count
    large, before = 36 if count == 144 else 20, steady(np.tile([4.0, 6.0], 100))
    if factor > 0.01 and known == 100 and count:  # (3 × 1 / 0.5)²
        assert runs_to_repeat(before, still, small, cause) == large
    gone = small._replace(heading_nees=np.full(200, np.nan))
    assert runs_to_repeat(steady(WIDE), still[:, :0], gone, cause) == count
    small = SmallNoise(3 * one, found, factor)
    assert runs_to_repeat(3 * still, steady(WIDE, 1), small, cause) == count


@pytest.mark.parametrize("times", [1.0, 1.25])
def test_the_sentence_about_less_noise_has_students_interval_without_skewness(times):
    z = np.random.default_rng(21).standard_normal(30)
    z = np.append(z, -z)  # symmetric
    after = times * (1.05 + 0.3 * (z - z.mean()) / z.std())
    pose, still = steady(np.tile([5.0, 7.0], 30)), np.ones((60, 2))
    low, high = stats.t.interval(0.9, 59, after.mean(), stats.sem(after))
    said = (
        f"the noise, the squared errors of the pose are {after.mean():.3g} times "
        f"(90 % interval {low:.3g} to {high:.3g})"
    )
    small = SmallNoise(3 * after, times * still[:, 0], 0.02)
    cause, text = excess_of(pose, still, small, 0.0, times)
    assert cause == "linearisation"
    assert text == f"With 2 % of {said}, so the excess vanishes with the noise."
    larger = SmallNoise(np.full(60, 12.0), still[:, 0])
    _, text = excess_of(pose, still, small._replace(larger=larger), 0.0, times)
    assert f"With 2 % of {said}, and with a tenth 4 times, so" in text
    for level, left in ((pose, 0.5), (steady(np.full(60, 1.8)), 0.25)):
        for part, cause in ((0.98, "linearisation"), (1.02, "cannot tell")):
            spread = part * left * np.sqrt(60) / stats.t.isf(0.05, 59) / z.std(ddof=1)
            wide, one = times * (1 + spread * (z - z.mean())), times * still[:, 0]
            changed = SmallNoise(3 * wide, one)
            assert excess_of(level, still, changed, 0.0, times)[0] == cause
            changed = SmallNoise(3 * one, wide)  # the same of the heading
            assert excess_of(3 * still, level / 3, changed, 0.0, times)[0] == cause


@pytest.mark.parametrize(
    ("before", "after", "spread", "cause"),
    [
        (1.12, 1.08, 0.001, "wrong covariance"),
        (1.12, 1.08, 0.5, "cannot tell"),
        (0.85, 0.92, 0.001, "wrong covariance"),
        (0.85, 0.92, 0.5, "cannot tell"),
    ],
)
def test_a_small_excess_stays_if_its_interval_shows_it(before, after, spread, cause):
    many = steady(before + spread * np.resize([-1.0, 1.0], 60))
    few = SmallNoise(3 * (after + spread * np.resize([-1.0, 1.0], 60)), np.ones(60))
    assert excess_of(many, np.ones((60, 2)), few, 0.0, 1.0)[0] == cause


def test_diverged_runs_that_make_the_average_are_counted():
    few = np.repeat([7.1, 0.3], [6, 34])
    _, text = excess_of(
        steady(np.full(40, 6.0)), np.ones((40, 1)), SmallNoise(3 * few, few), 0.0, 1.0
    )
    assert "are 1.32 times, and 6 of 40 runs diverged" in text


def shaken(mean, runs=20, spread=0.05):
    return mean + spread * np.resize([-1.0, 1.0], runs)


@pytest.mark.parametrize(
    ("many", "few", "lost", "grows", "change"),
    [
        (np.full(20, 3.0), np.full(20, 1.98), 0, np.inf, "shrinks"),
        (np.repeat([np.nan, 3.0], [2, 18]), np.full(20, 1.98), 0, np.inf, "shrinks"),
        (np.full(20, 3.0), np.repeat([2.9, 1.5], [2, 18]), 2, np.inf, "shrinks"),
        (np.full(20, 3.0), np.repeat([1.0, 2.9], 10), 0, np.inf, ""),
        (np.full(20, 2.0), np.repeat([1.6, 0.0], [16, 4]), 0, np.inf, ""),
        (np.repeat([3.0, 101], [16, 4]), np.repeat([4.0, 0], [16, 4]), 0, 10, "stays"),
        (np.repeat([3.0, 999], [16, 4]), np.repeat([21.0, 0], [16, 4]), 0, 10, "stays"),
        (np.full(20, 3.0), np.full(20, 2.0), 0, np.inf, "stays"),
        (np.full(20, 3.0), np.full(20, 21.0), 0, 10.0, "stays"),
        (np.full(20, 3.0), np.full(20, 21.1), 0, 10.0, "grows"),
        (np.full(20, 3.0), np.repeat([1.0, 21.0], [16, 4]), 0, np.inf, "shrinks"),
        (np.full(20, 3.0), np.repeat([1.0, 81.0], [15, 5]), 0, np.inf, "stays"),
        (np.full(20, 3.0), np.full(20, np.nan), 0, np.inf, ""),
        (np.full(4, 3.0), np.full(4, 1.0), 0, np.inf, ""),
        (np.full(5, 3.0), np.full(5, 1.0), 0, np.inf, "shrinks"),
        (shaken(1.8), shaken(1.7), 0, np.inf, "stays"),
        (shaken(1.8), shaken(1.1), 0, np.inf, "shrinks"),
        (shaken(1.8), shaken(9.9), 0, 10.0, "grows"),
        (shaken(1.8), shaken(8.9), 0, 10.0, "stays"),
        (shaken(1.8, spread=0.4), shaken(1.4)[::-1], 0, np.inf, ""),
        (shaken(0.4), shaken(0.5), 0, np.inf, "stays"),
        (shaken(0.4), shaken(0.9), 0, np.inf, "shrinks"),
        (np.repeat([30.0, 1.0], [2, 18]), np.ones(20), 2, np.inf, "shrinks"),
        (np.repeat([30.0, 2.0], [2, 18]), np.repeat([29.0, 1.0], [2, 18]), 2, 10.0,
         "stays"),
        (np.repeat([30.0, 1.0], [2, 18]), np.repeat([29.0, 1.0], [2, 18]), 2, 10.0,
         "stays"),
        (np.repeat([30.0, 1.0], [1, 19]), np.repeat([29.0, 1.0], [1, 19]), 1, 10.0,
         ""),
    ],
)  # fmt: skip
def test_an_excess_grows_stays_or_shrinks(many, few, lost, grows, change):
    sign = -1.0 if many.mean() < 1 else 1.0
    assert _change(many, few, np.arange(len(many)) < lost, sign, grows) == change


def test_knowledge_of_the_heading_is_tested_by_students_test():
    knowledge = np.random.default_rng(22).normal(0.85, 0.1, 30)
    expected = stats.ttest_1samp(knowledge, 0.9, alternative="less").pvalue
    assert spurious_knowledge(knowledge) == pytest.approx(expected)


def test_blame_is_the_smaller_p_value_of_two_rank_tests():
    rng = np.random.default_rng(23)
    for lost, slope in ((0, 0.1), (3, 0.02), (3, 0.0)):
        mistakes = rng.integers(0, 6, 40).astype(float)
        pose = rng.chisquare(3, (40, 10)) * (1 + slope * mistakes[:, None])
        pose[:lost] += 30
        mistakes[:lost] += 2
        many, gone = mistakes > np.median(mistakes), diverged_runs(pose)
        pairs = [(pose.mean(axis=1), many)] + [(mistakes, gone)] * (lost > 1)
        p_values = [
            stats.mannwhitneyu(x[rows], x[~rows], alternative="greater").pvalue
            for x, rows in pairs
        ]
        found = blame_association(pose, mistakes, None)
        assert found.p_value == pytest.approx(min(1, 2 * min(p_values)))
        assert found.share == np.mean(mistakes > 0)
        known = pose / (1.2 + slope * mistakes[:, None])
        paired = stats.wilcoxon(
            (pose - known).mean(axis=1), alternative="greater"
        ).pvalue
        more = gone.sum() - diverged_runs(known).sum()
        found = blame_association(pose, mistakes, known)
        both = paired, stats.binom.sf(more - 1, 40, 1e-3)
        assert found.p_value == pytest.approx(min(1, 2 * min(both)))
        assert f"would be {known.mean() / 3:.3g} per degree" in found.text
        if lost:  # in the lost runs alone
            found = blame_association(pose, mistakes, np.where(gone[:, None], 3, pose))
            more = stats.binom.sf(lost - 1, 40, 1e-3)
            assert found.p_value == pytest.approx(2 * more)


def test_errors_exceed_what_the_noise_explains_beyond_a_tenth():
    ratios = np.random.default_rng(24).normal(1.0, 0.2, 40)
    still = np.ones((40, 1))
    for times in np.linspace(1.0, 1.4, 201):
        each = times * ratios
        p_value = time_average_test(each / 1.1, 1).p_value
        expected = each.mean() > 1.1 and p_value < 0.01
        assert _exceeds(steady(3 * each), still[:, :0], 3.0) == expected
        assert _exceeds(9 * still, steady(3 * each, 1), 3.0) == expected
    assert not _exceeds(steady(3 * ratios), still, np.inf)


def interval_by_roots(values):
    """Return the 90 % interval of a mean, by the roots of Hall's cubic (1992)."""
    c = stats.skew(values) / np.sqrt(len(values))
    limit = stats.t.isf(0.05, len(values) - 1)
    low, high = (
        next(
            values.mean() - stats.sem(values) * root.real
            for root in np.roots([c**2 / 27, c / 3, 1, c / 6 - end])
            if abs(root.imag) < 1e-6
        )
        for end in (limit, -limit)
    )
    return max(low, 0), high


def test_the_interval_contains_the_mean_of_skewed_averages_in_nine_of_ten_studies():
    rng, inside, known = np.random.default_rng(27), 0, np.ones(20, bool)
    for _ in range(1000):
        score = np.minimum(rng.chisquare(1, 20), 6.0)  # below what counts as diverged
        found = _rest_of({"pose": score}, known, "pose", 1.0)
        inside += found.low <= 0.974 <= found.high
    assert 870 < inside < 930  # Student's interval: 84 %


def test_means_of_few_runs_are_tested_by_students_test():
    rng = np.random.default_rng(25)
    for n in (3, 5, 8) * 60:
        values = rng.normal(1.0, 1.0, n)
        test = stats.ttest_1samp(values, 0, alternative="greater")
        assert _is_positive(values) == (test.pvalue < 0.05)
        low, high = stats.t.interval(0.9, n - 1, values.mean(), stats.sem(values))
        before = rng.uniform(0.0, 4.0)
        left = np.clip(abs(before - 1) / 4, 0.25, 0.5)
        assert _is_small(before, values / 2, 1.0) == (high / 2 <= 1 + left)
        assert _is_small(before, values / 2, -1.0) == (max(low, 0) / 2 >= 1 - left)
        chosen = np.arange(n) < n // 2
        others = stats.mannwhitneyu(
            values[chosen], values[~chosen], alternative="greater"
        )
        assert _larger(values, chosen, n // 2) == others.pvalue
        assert _larger(values, chosen, n // 2 + 1) == 1
        assert _larger(values, ~chosen, n // 2 + 1) == 1


def test_the_excess_that_remains_with_less_noise_ignores_few_diverged_runs():
    rng = np.random.default_rng(26)
    for lost, sign, of in [
        *product((0, 1, 2, 3, 6), (1.0, -1.0), ("pose", "heading"))
    ] * 6:
        after = {
            name: rng.uniform(0.6, 1.6) * rng.gamma(20, 0.05, 40)
            for name in ("pose", "heading")
        }
        after["pose"][:lost] = 7.1
        known = np.arange(40) > 38 - rng.choice([39, 34], p=[0.5, 0.5])
        gone = known & (after["pose"] > stats.chi2.isf(1e-4, 3) / 3)
        is_few = gone.sum() <= 0.05 * known.sum()
        kept = known & ~gone if is_few else known
        means, off = {name: x[kept].mean() for name, x in after.items()}, {}
        for name, mean in means.items():
            margin = np.clip(mean, 1 / 1.1, 1.1)
            p_value = time_average_test(after[name][kept] / margin, 1).p_value
            if margin != mean and (mean - 1) * sign > 0 and p_value < 0.025:
                off[name] = abs(np.log(mean))
        found = _rest_of(after, known, of, sign)
        assert found.remains == (bool(off) or (sign > 0 and not is_few))
        assert found.of == (max(off, key=off.get) if off else of)
        assert found.ratio == pytest.approx(means[found.of])
        interval = interval_by_roots(after[found.of][kept])
        assert (found.low, found.high) == pytest.approx(interval)
        np.testing.assert_array_equal(found.kept, kept)
        assert (found.diverged, found.few_diverged) == (gone.sum(), is_few)
