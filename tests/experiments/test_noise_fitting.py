"""Fitting the noise of a log, from Python and from the command line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from commands import slamgym
from drawn import check_looks
from recordings import recorded
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.signal import lfilter
from scipy.stats import chi2

from slamgym.estimator.filters.drive_likelihood import DriveEvents, DriveRecord
from slamgym.estimator.kernels.scan_update import ADDED, GATED, SKIPPED, USED
from slamgym.evaluation import autocorrelation, ljung_box, pose_nees
from slamgym.experiments.command_line.tables import advice, noise_comparison_table
from slamgym.experiments.job_folders import files_below
from slamgym.experiments.logs import (
    OdometryRow,
    Scan,
    SlamLog,
    read_slamlog,
    write_slamlog,
)
from slamgym.experiments.logs.ground_truth import without_identities
from slamgym.experiments.noise_fitting import (
    fit_noise,
    noise_fit_figure,
    search,
    summarise_fit,
    write_noise,
)
from slamgym.experiments.noise_fitting.fit import (
    FACTORS,
    Whiteness,
    _crossing,
    _judged,
    above_zero,
    nees_bounds,
    positive_sum,
    whiteness,
)
from slamgym.experiments.noise_fitting.intervals import (
    Interval,
    intervals,
    profile_crossing,
)
from slamgym.experiments.noise_fitting.scoring import (
    associated_log,
    curvature,
    events_of,
    maximise,
    parts_of,
    sample_of,
    scores,
    stretches_of,
)
from slamgym.experiments.noise_fitting.search import (
    LogLikelihood,
    noise_of,
    positive_start,
)
from slamgym.experiments.noise_fitting.summary import options_line
from slamgym.experiments.run_and_replay import replay, settings_for

MOTION, SENSOR = (0.05, 0.03, 0.02), (0.02, 0.08)


def a_log(seed=3, *, steps=150, world="six_landmarks", **changes):
    noise = {
        "motion": changes.pop("motion", {"std": MOTION}),
        "sensor": {"std": SENSOR, **changes.pop("sensor", {})},
    }
    return recorded(world, seed, steps=steps, **noise, **changes)


def fitted(log, *, start=(0.2, 0.2, 0.2, 0.1, 0.3), **settings):
    noise = {"motion_std": start[:3], "measurement_std": start[3:]}
    return fit_noise(log, settings_for(log, estimator="invariant", **noise, **settings))


@pytest.fixture(scope="module")
def example():
    return fitted(a_log())


def test_a_log_gives_its_noise_back(example):
    truth = (*MOTION, *SENSOR)
    assert [noise.name for noise in example.noise][:5] == ["σx", "σy", "σα", "σβ", "σr"]
    for noise, true in zip(example.noise, truth, strict=False):
        spread = np.log(noise.high / noise.value) / 1.96
        assert abs(np.log(noise.value / true)) < 4 * spread < 2
    assert example.noise[5].verdict == "zero"
    assert example.noise[5].value == 0
    assert 0 < example.noise[5].high < 0.003


@pytest.mark.slow
def test_the_intervals_hold_the_noise_of_most_logs():
    """Fewer than 24 of 30 intervals of 95 % have a probability of .003."""
    held = 0
    for seed in range(100, 106):
        fit = fitted(a_log(seed))
        for noise, true in zip(fit.noise, (*MOTION, *SENSOR), strict=False):
            held += noise.low < true < noise.high
    assert held >= 24


def assert_same(fit, other):
    for a, b in zip(fit.noise, other.noise, strict=True):
        assert a.verdict == b.verdict
        assert b.value == pytest.approx(a.value, rel=0.01, abs=1e-9)
        assert b.low == pytest.approx(a.low, rel=0.02, abs=1e-9)
        assert b.high == pytest.approx(a.high, rel=0.02)


FAR = (0.01, 0.004, 0.3, 0.002, 0.9)


@pytest.mark.slow
def test_the_intervals_of_a_very_short_log_hold_the_fitted_noise():
    log = recorded("six_landmarks", 0, steps=3)
    for noise in fit_noise(log, settings_for(log)).noise:
        assert noise.low <= noise.value <= noise.high


def test_the_fit_does_not_depend_on_where_it_starts(example):
    """From there a climb ends at σy → 0, where the slope along log σy vanishes."""
    assert_same(example, fitted(a_log(), start=FAR))


@pytest.mark.slow
def test_motion_noise_that_may_be_zero_is_suggested_at_its_upper_end():
    fit = fitted(a_log(6, steps=60, motion={"std": (0.05, 0.05, 0.0)}))
    along, across, turn = fit.noise[:3]
    assert (turn.value, turn.verdict) == (0, "zero")
    expected = pytest.approx((along.value, across.value, turn.high), rel=1e-3)
    assert fit.suggested.settings.motion_std == expected
    summary = summarise_fit(fit)
    without, suggested = (
        summary["runs"][stage]["nees"]["per_degree"]
        for stage in ("fitted", "suggested")
    )
    assert without > 1 > suggested > 0.5
    assert "σα instead of 0: without it" in shown(advice(summary))
    endless = [turn._replace(high=np.inf, before=0.2)] * 3
    assert above_zero(np.zeros(7), endless).tolist() == [0.2, 0.2, 0.2, 0, 0, 0, 0]


def shown(table):
    return "".join(str(cell) for column in table.columns for cell in column.cells)


def test_white_innovations_suggest_no_inflation(example):
    assert example.suggested is example.fitted
    told = []
    summary = summarise_fit(example, progress=lambda *numbers: told.append(numbers))
    assert told == [(0, 3), (1, 3), (2, 3)]
    runs = summary["runs"]
    assert runs["suggested"] is runs["fitted"]


def test_the_calibration_is_where_the_nees_of_replays_crosses_its_bounds(example):
    settings = example.fitted.settings

    def excess(factor, bound):
        """Return the log of the mean NEES per degree by a bound, of a replay."""
        std = tuple(factor * np.array(settings.measurement_std))
        options = settings.options | {"range_std_per_metre": 0.0}
        noise = replace(settings, measurement_std=std, options=options)
        trace = replay(example.log, noise.make(example.log.start)).trace
        args = trace.true_poses, trace.poses, trace.pose_covariances
        nees = pose_nees(*args, frame="invariant")
        nees = nees[np.isfinite(nees)]
        return np.log(nees.mean() / 3 / (1.0, *nees_bounds(nees)[::-1])[bound])

    for bound, found in enumerate(example.calibration):
        if np.isinf(found):
            assert excess(FACTORS[-1], bound) > 0
            continue
        k = int(np.searchsorted(FACTORS, found))
        ends = [excess(factor, bound) for factor in FACTORS[k - 1 : k + 1]]
        between = np.interp(0.0, ends[::-1], np.log(FACTORS[k - 1 : k + 1])[::-1])
        assert np.log(found) == pytest.approx(between, abs=2e-3)


@pytest.mark.parametrize(
    ("ratios", "factor"),
    [([2.0, 1.5, 1.2], np.inf), ([0.9, 0.8, 0.5], 0.0), ([2.0, 0.5, 0.1], 2**0.5)],
)
def test_a_factor_beyond_those_tried_is_open(ratios, factor):
    assert _crossing(np.log([1.0, 2.0, 4.0]), np.log(ratios)) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("found", "text"),
    [
        ((1.14, 0.609, None), "by 1.14 (at least 0.61) for a pose NEES of 1"),
        ((1.14, 0.0, 3.0), "by 1.14 (at most 3) for a pose NEES of 1"),
        ((1.14, 0.609, 3.0), "by 1.14 (0.61 to 3) for a pose NEES of 1"),
        ((1.14, 0.0, None), "by 1.14 (not known better) for a pose NEES of 1"),
        ((None, 9.0, None), "no factor of σβ and σr up to 16 gives a pose NEES of 1"),
        ((0.0, 0.0, 0.5), "σβ and σr times 0.25 give a pose NEES below 1"),
    ],
)
def test_the_advice_states_open_ends_and_what_remains(found, text):
    calibration = dict(zip(("factor", "low", "high"), found, strict=True))
    summary = {
        "noise": [],
        "inflation": {"bearing": 1.0, "range": 1.0},
        "calibration": calibration | {"tried": [0.25, 16.0]},
        "readings": 269,
        "runs": {
            "fitted": {"rejected": 13},
            "suggested": {"nees": {"per_degree": 1.4}},
        },
    }

    def said():
        return shown(advice(summary))

    assert text in said()
    assert "stays overconfident" not in said()
    summary["runs"]["suggested"]["nees"]["per_degree"] = 1.6
    assert "the pose NEES is 1.6 per degree with the suggested noise" in said()
    assert "none needed" in said()
    summary["runs"]["fitted"]["rejected"] = 125
    assert "none needed" not in said()
    assert "125 of 269 readings (46%), which fit no noise" in said()


@pytest.mark.parametrize("count", [1, 2, 3, 5, 64, 401])
def test_the_bounds_are_those_of_the_products_of_all_lags(count):
    rng = np.random.default_rng(4)
    nees = 3 + lfilter([0.6], [1.0, -0.8], rng.chisquare(3, count) - 3)
    excess = nees - 3
    products = [excess[k:] @ excess[:-k] for k in range(1, count // 2)]
    together = 1 + 2 * positive_sum(np.array(products) / (6 * count))
    degrees = max(3.0, 3 * count / together)
    expected = chi2.ppf([0.025, 0.975], degrees) / degrees
    assert nees_bounds(nees) == pytest.approx(expected)
    assert count < 64 or 3 < degrees < 3 * count


def test_whiteness_is_that_of_single_scans_and_of_single_landmarks():
    rng, scans, seen = np.random.default_rng(6), 90, 3
    errors = lfilter([1.0], [1.0, -0.6], rng.standard_normal((scans, seen, 2)), axis=0)
    errors[..., 1] += 3 * lfilter([1], [1, -0.9], rng.standard_normal((scans, 1)), 0)
    outcomes = np.where(rng.random((scans, seen)) < 0.8, USED, SKIPPED)
    outcomes[7], outcomes[8] = ADDED, GATED  # of these scans no reading is used
    is_used = outcomes == USED
    first = np.arange(0, scans * seen + 1, seen)
    drive = DriveEvents(None, None, None, np.tile(range(seen), scans), first)
    innovations = np.where(is_used[..., None], errors, 99.0).reshape(1, -1, 2)
    record = DriveRecord(
        *(None, None, is_used.sum(axis=1)[None], None, None, None),
        *(innovations, outcomes.reshape(1, -1)),
    )
    shared = is_used.sum() / is_used.any(axis=1).sum()
    for axis, found in enumerate(whiteness(drive, record)):
        of_scans = [
            errors[t, is_used[t], axis].sum() / np.sqrt(is_used[t].sum())
            for t in range(scans)
            if is_used[t].any()
        ]
        of_each = [errors[is_used[:, k], k, axis] for k in range(seen)]
        series = np.full((seen, max(map(len, of_each))), np.nan)
        for k, values in enumerate(of_each):
            series[k, : len(values)] = values
        p_values, factors = [], []
        for each, together in ((np.array([of_scans]), 1.0), (series, shared)):
            statistic = ljung_box(each, lags=10).statistic / together
            p_values.append(chi2.sf(statistic, 10))
            lags = autocorrelation(each, lags=min(50, each.shape[1] // 2))[0]
            factors.append(np.sqrt(1 + 2 * positive_sum(lags)))
        assert found.p_value == pytest.approx(2 * min(p_values))
        assert found.first == pytest.approx(lags[0])
        assert found.inflation == pytest.approx(np.sqrt(np.prod(factors)))
    nothing = record._replace(
        used=0 * record.used, outcomes=0 * record.outcomes + ADDED
    )
    for found in whiteness(drive, nothing):
        assert np.isnan(found[:2]).all()
        assert found.inflation == 1


@pytest.mark.parametrize(
    ("shape", "is_tested"), [((2, 19), False), ((1, 39), False), ((2, 20), True)]
)
def test_few_innovations_are_not_tested(shape, is_tested):
    series = np.random.default_rng(1).standard_normal(shape)
    assert np.isfinite(_judged(series).p_value) == is_tested


@pytest.mark.slow
def test_range_noise_that_grows_with_range_is_found():
    log = a_log(sensor={"range_std_per_metre": 0.03}, steps=300)
    growing = fitted(log).noise[5]
    assert growing.verdict == "fitted"
    assert growing.low < 0.03 < growing.high


def test_outliers_do_not_decide():
    log = a_log()
    events = list(log.events)
    for k in (41, 91, 141):
        scan = next(e for e in events[k:] if isinstance(e, Scan))
        wrong = scan.measurements.copy()
        wrong[0] += (1.0, 4.0)
        events[events.index(scan)] = replace(scan, measurements=wrong)
    fit = fitted(replace(log, events=tuple(events)))
    assert fit.fitted.rejected == 3
    assert fit.noise[4].low < SENSOR[1] < fit.noise[4].high


def test_a_noise_on_which_nothing_depends_keeps_its_value():
    """A robot that turns on the spot does not slip along or across."""
    rng = np.random.default_rng(4)
    places, heading, events = np.array([[3.0, 1.0], [-2.0, 4.0]]), 0.0, []
    for t in range(200):
        if t:
            events.append(OdometryRow(float(t), 0.0, 0.1, 1.0))
            heading += 0.1 + 0.02 * rng.standard_normal()
        bearing = np.arctan2(places[:, 1], places[:, 0]) - heading
        readings = np.column_stack([bearing, np.hypot(*places.T)])
        readings += (0.02, 0.05) * rng.standard_normal((2, 2))
        events.append(Scan(float(t), readings, [0, 1]))
    fit = fitted(SlamLog("turning", events=tuple(events)))
    along, _, turning, bearing, _, _ = fit.noise
    assert along.verdict in {"zero", "unknown"}
    assert turning.verdict == bearing.verdict == "fitted"
    assert turning.low < 0.02 < turning.high


def test_at_rest_without_noise_at_rest_the_motion_noise_is_unknown():
    log = a_log(steps=60)
    standing = [
        replace(e, d=0.0, alpha=0.0) if isinstance(e, OdometryRow) else e
        for e in log.events
    ]
    standing[1] = replace(standing[1], d=1e-9)
    scan, readings = log.events[0], log.events[0].measurements
    rng = np.random.default_rng(0)
    for k, event in enumerate(standing):
        if isinstance(event, Scan):
            noise = SENSOR * rng.standard_normal(readings.shape)
            standing[k] = replace(scan, t=event.t, measurements=readings + noise)
    header = {**log.header, "noise_at_rest": "false"}
    options = {"gate_probability": 1 - 1e-6}
    fit = fitted(replace(log, events=tuple(standing), header=header), options=options)
    assert fit.fitted.settings.options.items() >= options.items()
    by_name = {noise.name: noise for noise in fit.noise}
    assert by_name["σβ"].verdict == by_name["σr"].verdict == "fitted"
    for name in ("σx", "σy", "σα"):
        assert by_name[name].verdict in {"unknown", "zero"}


def test_a_noise_that_the_readings_do_not_determine_keeps_its_value(monkeypatch):
    unknown = Interval("unknown", 0.0, np.inf)
    monkeypatch.setattr(search, "intervals", lambda _, at, *__: [unknown] * len(at))
    inflated = Whiteness(0.0, 0.5, 2.0), Whiteness(0.0, 0.5, 3.0)
    monkeypatch.setattr(f"{fit_noise.__module__}.whiteness", lambda *_: inflated)
    options = {"range_std_per_metre": 0.01, "bearing_std_metres": 0.02}
    found = fitted(a_log(steps=30), options=options)
    assert [each.value for each in found.noise[:5]] == [0.2, 0.2, 0.2, 0.1, 0.3]
    ends = noise_of(found.fitted.settings) * (1, 1, 1, 2, 3, 3, 2)
    np.testing.assert_allclose(noise_of(found.suggested.settings), ends)


def test_scoring_finds_the_spread_of_normal_numbers_and_its_interval():
    x = np.random.default_rng(2).normal(0, 3.0, 4000)

    tried = []

    def likelihoods(sigmas):
        tried.append(len(sigmas))
        return -0.5 * (x / sigmas) ** 2 - np.log(sigmas)

    best = maximise(likelihoods, np.array([[0.1], [50.0]]))
    assert best.converged
    assert best.passes == sum(tried)
    assert best.parameters[0] == pytest.approx(np.sqrt(np.mean(x**2)), rel=1e-3)
    bent = curvature(likelihoods, np.log(best.parameters), np.array([0.05]))
    assert bent[0, 0] == pytest.approx(2 * len(x), rel=0.01)


def test_the_slope_beside_a_jump_is_that_of_the_side_without_it():
    def likelihoods(parameters):
        return 3 * np.log(parameters) + (parameters > np.exp(0.005))

    for beside_jumps, slope in ((False, 3 + 1 / 0.02), (True, 3)):
        found = scores(likelihoods, np.zeros(1), beside_jumps=beside_jumps)
        assert found.gradient[0] == pytest.approx(slope)
    assert scores(likelihoods, np.zeros(1)).gradient[0] == pytest.approx(53)


@pytest.mark.parametrize("bent", [100.0, -100.0])
def test_the_width_of_an_interval_is_by_curvature_or_else_by_information(bent):
    def likelihoods(parameters):
        return -0.5 * bent * np.log(parameters) ** 2

    information = np.array([[400.0]])
    (found,) = intervals(likelihoods, np.ones(1), 0.0, information)
    width = 0.1 if bent > 0 else 0.05
    assert found[1:] == pytest.approx(np.exp([-1.96 * width, 1.96 * width]))


def test_curvature_is_the_second_derivative_along_all_pairs_of_parameters():
    A = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]])

    def likelihoods(parameters):
        theta = np.log(parameters) - (0.1, 0.2, 0.3)
        return -0.5 * np.einsum("ki,ij,kj->k", theta, A, theta)[:, None]

    found = curvature(likelihoods, np.zeros(3), np.array([0.01, 0.03, 0.1]))
    np.testing.assert_allclose(found, A, rtol=1e-9)


def two_spreads(parameters):
    """Return log likelihoods of 120 numbers of variance a², 120 of variance a² + b²."""
    x = np.random.default_rng(5).standard_normal(240)
    x[120:] *= np.hypot(1.0, 0.8)
    a, b = parameters.T
    variances = np.repeat(np.stack([a**2, a**2 + b**2], axis=1), 120, axis=1)
    return -0.5 * (x**2 / variances + np.log(variances))


def test_a_search_that_begins_near_zero_does_not_stay_there():
    tried = []

    def counted(parameters):
        tried.append(len(parameters))
        return two_spreads(parameters)

    near = maximise(counted, np.array([[1.0, 1e-5]]))
    assert near.passes == sum(tried)
    far = maximise(two_spreads, np.array([[1.0, 1.0]]))
    assert far.parameters[1] > 0.5
    np.testing.assert_allclose(near.parameters, far.parameters, rtol=0.01)


@pytest.mark.parametrize("start", [0.2, 1.5])
def test_the_profile_is_that_of_fitting_the_other_parameter_anew(start):
    best = maximise(two_spreads, np.array([[1.0, 1.0]]))
    level = best.log_likelihood - 1.92

    def profile(b):
        def lost(a):
            return -two_spreads(np.array([[a, b]])).sum()

        return -minimize_scalar(lost, bounds=(0.3, 3), method="bounded").fun - level

    top = best.parameters[1]
    expected = brentq(profile, *((1e-3, top) if start < top else (top, 5.0)))
    found = profile_crossing(two_spreads, best.parameters, 1, start, level)
    assert found == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("bend", "at", "expected"),
    [
        (1.0, 1.0, ("zero", 0.0, 1 + 1.92**0.5)),
        (1.6, 1.0, ("fitted", 0.0, 1 + 1.2**0.5)),  # zero is beyond 90 %, not 95 %
        (3.0, 1.0, ("fitted", 1 - 0.64**0.5, 1 + 0.64**0.5)),
        (3.0, 0.0, ("zero", 0.0, 0.64**0.5)),
        (0.0, 1.0, ("unknown", 0.0, np.inf)),
    ],
)
def test_intervals_end_where_the_likelihood_has_fallen(bend, at, expected):
    def likelihoods(parameters):
        return -bend / 40 * (parameters - at) ** 2 + np.zeros(40)

    information = np.full((1, 1), 2 * bend) if at else np.empty((0, 0))
    (found,) = intervals(likelihoods, np.array([at]), 0.0, information)
    assert found.verdict == expected[0]
    assert found[1:] == pytest.approx(expected[1:], rel=2e-3)


def test_the_end_is_found_where_other_parameters_must_move_far_together():
    rng = np.random.default_rng(83)
    size = int(rng.integers(1, 4))
    shares = (rng.random((6, size)) < 0.6) + 0.05 * rng.random((6, size))
    true = np.exp(rng.normal(0, 1, size))
    numbers = rng.standard_normal((6, 8)) * np.sqrt(shares @ true**2)[:, None]

    def mixed(parameters):
        variances = (np.atleast_2d(parameters) ** 2 @ shares.T)[..., None]
        terms = -0.5 * np.log(variances) - 0.5 * numbers**2 / variances
        return terms.reshape(len(variances), -1)

    best = maximise(mixed, true[None])
    level, start = best.log_likelihood - 1.92, 1.3 * best.parameters[2]
    end = profile_crossing(mixed, best.parameters, 2, start, level)

    def cost(others):
        return -mixed(np.array([[*np.exp(others), end]])).sum()

    found = minimize(cost, np.log(best.parameters[:2]), method="Nelder-Mead")
    assert -found.fun == pytest.approx(level, abs=0.02)


def test_the_end_beside_a_jump_of_the_likelihood_is_found_in_few_steps():
    best = maximise(two_spreads, np.array([[1.0, 1.0]]))
    level, edge, calls = best.log_likelihood - 1.92, 1.01 * best.parameters[0], []

    def jumping(parameters):
        calls.append(parameters)
        found = two_spreads(parameters)
        found[:, 7] -= 5.0 * (parameters[:, 0] > edge)
        return found

    found = profile_crossing(jumping, best.parameters, 1, 0.2, level)
    expected = brentq(
        lambda b: two_spreads(np.array([[edge, b]])).sum() - level, 1e-3, 0.8
    )
    assert found == pytest.approx(expected, rel=0.05)
    assert len(calls) < 20


def test_a_climb_ends_beside_a_jump_of_the_likelihood():
    best, calls = maximise(two_spreads, np.array([[1.0, 1.0]])), []
    edge = 1.005 * best.parameters[0]

    def jumping(parameters):
        calls.append(parameters)
        found = two_spreads(parameters)
        found[:, 7] += 5.0 * (parameters[:, 0] < edge)
        return found

    found = maximise(jumping, np.array([[1.0, 1.0]]))
    assert found.converged
    np.testing.assert_allclose(found.parameters, best.parameters, rtol=0.02)
    assert len(calls) < 16


def test_the_summary_and_its_table_are_those_of_replays(example):
    assert all(white.p_value > 1e-3 for white in example.fitted.whiteness)
    white = (each._replace(inflation=k) for k, each in enumerate(example.fitted[3], 2))
    fit = replace(example, fitted=example.fitted._replace(whiteness=tuple(white)))
    summary = summarise_fit(fit)
    assert summary["inflation"] == {"bearing": 2, "range": 3}
    runs = summary["runs"]
    assert list(runs) == ["before", "fitted", "suggested"]
    table = noise_comparison_table(summary)
    for run, column in zip(runs.values(), table.columns[1:], strict=True):
        numbers = [run["log_likelihood"], run["readings"]["rejected"]]
        numbers += [run[key]["per_degree"] for key in ("nis", "nees")]
        numbers += [*run["ate"].values(), run["landmark_rmse"]["aligned"]]
        numbers += [run["whiteness"][key]["p"] for key in ("bearing", "range")]
        assert [*column.cells] == [f"{x:.4g}" for x in numbers]
    assert 0.9 < runs["fitted"]["nis"]["per_degree"] < 1.1
    assert runs["fitted"]["log_likelihood"] > runs["before"]["log_likelihood"]
    assert runs["fitted"]["ate"]["raw"] > 0
    json.dumps(summary, allow_nan=False)


def test_the_figure_has_a_column_for_each_noise(example):
    figure = noise_fit_figure(example)
    assert len(figure.axes) == 4
    assert figure.axes[0].get_title(loc="left") == "bearing, before"
    check_looks(figure, "noise_fit_figure")


def with_readings(log, change):
    """Return a log whose readings (m, 2) are changed."""
    events = tuple(
        replace(event, measurements=change(event.measurements))
        if isinstance(event, Scan)
        else event
        for event in log.events
    )
    return replace(log, events=events)


@pytest.mark.parametrize("options", [{"bearing_std_metres": 0.1}, {}])
def test_bearing_noise_that_shrinks_with_range_is_found(options):
    rng = np.random.default_rng(8)

    def noisier(readings):
        added = 0.4 / readings[:, 1] * rng.standard_normal(len(readings))
        return readings + np.column_stack([added, np.zeros_like(added)])

    log = with_readings(a_log(sensor={"std": (1e-4, 0.08)}), noisier)
    fit = fitted(log, options=options)
    noise = fit.noise[6]
    assert (noise.name, noise.verdict) == ("σβ in metres", "fitted")
    assert noise.low < 0.4 < noise.high
    assert f"--option bearing_std_metres={noise.value:.4g}" in options_line(fit.fitted)


@pytest.mark.slow
def test_a_needless_bearing_noise_in_metres_is_zero_in_the_options_too():
    fit = fitted(a_log(steps=60), options={"bearing_std_metres": 0.1})
    assert (fit.noise[6].value, fit.noise[6].verdict) == (0, "zero")
    assert "--option bearing_std_metres=0 " in options_line(fit.suggested)


def test_a_drive_in_parts_has_the_likelihood_of_its_parts():
    log = a_log(steps=40)
    settings = settings_for(log, estimator="invariant")
    events = events_of(log).events
    parts = parts_of(events, stretches_of(events, 4))
    assert len(parts) > 3
    assert all(part.landmarks.max() < 6 for part in parts)
    assert sum(len(part.motions) for part in parts) == len(events.motions)
    slam, noise = settings.make(log.start), noise_of(settings)[None]
    whole = LogLikelihood(slam, events, most_landmarks=4).record(noise)
    alone = [LogLikelihood(slam, part).record(noise) for part in parts]
    for name in ("log_likelihoods", "innovations", "outcomes", "poses"):
        joined = np.concatenate([getattr(record, name) for record in alone], axis=1)
        np.testing.assert_array_equal(getattr(whole, name), joined)
    np.testing.assert_array_equal(
        np.concatenate([part.readings for part in parts]), events.readings
    )


def test_motions_without_a_scan_belong_to_the_next_one():
    log = a_log(steps=40)
    kept = [e for e in log.events if isinstance(e, OdometryRow) or e.t % 3 == 0]
    events = events_of(replace(log, events=tuple(kept))).events
    settings = settings_for(log, estimator="invariant")
    likelihood = LogLikelihood(settings.make(log.start), events)
    noise, is_read = noise_of(settings)[None], np.diff(events.first_readings) > 0
    assert is_read.sum() == 14
    by_step = likelihood.record(noise).log_likelihoods
    np.testing.assert_array_equal(likelihood.of(noise), by_step[:, is_read])
    np.testing.assert_array_equal(by_step[:, ~is_read], 0)


def test_a_drive_past_few_landmarks_is_one_part():
    log = a_log(steps=10)
    events = events_of(log).events
    assert parts_of(events, stretches_of(events, 6)) == (events,)


def test_a_sample_is_evenly_spread_parts_of_a_drive(monkeypatch):
    log = a_log(steps=60)
    settings, events = settings_for(log, estimator="invariant"), events_of(log).events
    stretches = stretches_of(events, 4)
    sampled, chosen = sample_of(events, stretches, len(events.readings) // 3 + 1)
    slam, noise = settings.make(log.start), noise_of(settings)[None]
    parts = parts_of(events, stretches)[1::3]
    alone = [LogLikelihood(slam, part).of(noise) for part in parts]
    likelihood = LogLikelihood(slam, sampled, stretches=chosen)
    np.testing.assert_array_equal(likelihood.of(noise), np.concatenate(alone, axis=1))
    dropped = np.zeros(len(sampled.readings), dtype=bool)
    dropped[0] = True
    kept = likelihood.without(dropped)
    assert len(kept.parts) == len(parts)
    assert len(kept.parts[0].readings) == len(parts[0].readings) - 1
    whole = LogLikelihood(slam, events)
    assert whole.sample(len(events.readings)) is whole
    assert whole.sample(10) is whole  # one stretch holds all landmarks of this world
    monkeypatch.setattr(search, "SAMPLED_LANDMARKS", 4)
    again = whole.sample(len(events.readings) // 3 + 1)
    np.testing.assert_array_equal(again.of(noise), likelihood.of(noise))


def test_a_stretch_ends_before_the_step_with_one_landmark_too_many():
    seen = [[0, 1], [1, 2], [3], [4, 0], [], [5], [6, 7, 8, 9], [6]]
    first = np.cumsum([0, *map(len, seen)])
    drive = DriveEvents(None, None, None, np.concatenate(seen).astype(int), first)
    assert stretches_of(drive, 3) == [(0, 2), (2, 5), (5, 6), (6, 7), (7, 8)]


@pytest.mark.parametrize(
    ("noise", "start"),
    [
        ((0, 0, 0, 0, 0, 0, 0), (0.01, 0.01, 0.001, 1e-4, 1e-4, 2e-5, 0)),
        ((0, 0, 0.3, 0, 0, 0.02, 0.5), (0.01, 0.01, 0.3, 0.01, 0.01, 0.02, 0.5)),
        ((0.1, 0.2, 0, 0.4, 0.5, 0, 0), (0.1, 0.2, 0.02, 0.4, 0.5, 0.01, 0)),
    ],
)
def test_a_search_begins_at_a_share_of_the_noise_beside_a_zero(noise, start):
    found = positive_start(np.array(noise, dtype=float), 5.0)
    assert found.tolist() == pytest.approx(start)


def test_the_associations_of_a_filter_become_identities_of_the_log():
    log = a_log(steps=60)
    hidden = without_identities(log)
    settings = settings_for(hidden, estimator="invariant")
    known = associated_log(hidden, settings)
    true, found = (
        {
            (scan.t, *reading): landmark
            for scan in each.scans
            for reading, landmark in zip(
                scan.measurements.tolist(), scan.landmark_ids, strict=True
            )
        }
        for each in (log, known)
    )
    kept = {k: v for k, v in hidden.header.items() if k != "identities"}
    assert known.header == kept != {}
    pairs = {(true[reading], landmark) for reading, landmark in found.items()}
    assert len(pairs) == len(dict(pairs)) == len({i for _, i in pairs}) == 6
    motions = [e for e in known.events if isinstance(e, OdometryRow)]
    assert motions == [e for e in log.events if isinstance(e, OdometryRow)]
    assert associated_log(replace(hidden, motion="midpoint"), settings).motion == (
        "turn-last"  # as the rows of its drive are
    )


def test_the_comparison_of_a_log_without_identities_is_on_its_associations():
    log = without_identities(a_log(steps=60))
    fit = fitted(log, start=(*MOTION, *SENSOR))
    summary = summarise_fit(fit)
    assert fit.is_associated
    assert summary["runs"]["before"]["readings"]["added"] == 6
    assert "gate" not in summary["options"]  # landmark management has its own
    assert summary["runs"]["before"]["settings"]["options"]["management"]


@pytest.mark.slow
def test_readings_without_identity_are_associated_once():
    log, ends = a_log(sensor={"identities": False}, steps=150), []
    noise = {
        "motion_std": 3 * np.array(MOTION),
        "measurement_std": 3 * np.array(SENSOR),
    }
    options = {"management": {"association": "nearest"}}
    settings = settings_for(log, estimator="invariant", **noise, options=options)

    def note(done, steps):
        ends.append(done == steps)

    fit = fit_noise(log, settings, progress=note)
    assert sum(ends) == 1
    by_name = {noise.name: noise for noise in fit.noise}
    for name, true in (("σβ", SENSOR[0]), ("σr", SENSOR[1])):
        assert abs(np.log(by_name[name].value / true)) < 0.25


MOVE = OdometryRow(1.0, 1.0, 0.1, 1.0)
FIRST, AGAIN, NOT_FINITE = (
    Scan(t, [(0.1, distance)], [1]) for t, distance in ((0, 2), (1, 2), (1, np.nan))
)


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ((MOVE,), "holds no scan"),
        ((FIRST, AGAIN), "no motion"),
        ((FIRST, MOVE), "no landmark twice"),
        ((FIRST, MOVE, NOT_FINITE), "readings must be finite"),
    ],
)
def test_a_log_that_says_nothing_is_refused_in_one_line(events, message):
    with pytest.raises(ValueError, match=message):
        fitted(SlamLog("bad", events=events))


def test_exact_readings_are_refused():
    exact = (
        Scan(0.0, [(0.0, 3.0)], [1]),
        OdometryRow(1.0, 1.0, 0.0, 1.0),
        Scan(1.0, [(0.0, 2.0)], [1]),
    )
    with pytest.raises(np.linalg.LinAlgError, match="no noise in bearing"):
        fitted(SlamLog("exact", events=exact))


def test_a_search_begins_at_the_most_likely_multiple_and_refuses_to_end_on_its_way(
    monkeypatch,
):
    log = a_log(steps=20)
    settings = settings_for(log, estimator="invariant")
    likelihood = LogLikelihood(settings.make(log.start), events_of(log).events)
    start = search._coarse_start(likelihood, noise_of(settings))
    tried = start.noise * np.repeat([(0.25, 1), (4, 1), (1, 0.25), (1, 4)], (3, 4), 1)
    most, *others = likelihood.of(np.vstack([start.noise, tried])).sum(axis=1)
    assert start.likelihood == pytest.approx(most)
    assert most > max(others)

    def unfinished(*arguments, **named):
        return maximise(*arguments, **named)._replace(converged=False)

    events = likelihood.events
    flipped = replace(likelihood, events=events._replace(readings=-events.readings))
    for each in (likelihood, flipped):
        assert search._typical_range(each) == np.median(events.readings[:, 1])
    before = start.noise.copy()
    fit = search._fit(likelihood, start)
    free = np.arange(7) != 2
    for std, is_plain in ((0.145, True), (0.155, False)):
        information = np.diag([1e9, 1, 1, 1, std**-2, 1e9])
        entry = fit._replace(free=free, information=information)
        assert search._is_plain(entry, 5) == is_plain
    np.testing.assert_array_equal(start.noise, before)
    search._refuse_diverged(fit._replace(noise=np.full(7, 499.0)))
    with pytest.raises(np.linalg.LinAlgError, match=f"{fit.passes} pas.*metres 501"):
        search._refuse_diverged(fit._replace(noise=np.full(7, 501.0)))
    search._refuse_most(np.array([True, False]))  # one half
    with pytest.raises(np.linalg.LinAlgError, match="2 of 3 readings"):
        search._refuse_most(np.array([True, False, True]))
    monkeypatch.setattr(search, "ROUNDS", 1)
    monkeypatch.setattr(search.scoring, "maximise", unfinished)
    with pytest.raises(
        np.linalg.LinAlgError, match=r"after \d+ passes it is at σx 0\.\d"
    ):
        fitted(log)


def test_a_filter_off_the_kernels_is_refused():
    log = a_log(steps=5)
    with pytest.raises(ValueError, match="runs in batches"):
        fit_noise(log, settings_for(log, estimator="unscented"))


@pytest.mark.slow
def test_the_command_writes_the_noise_into_the_header_and_nothing_else(tmp_path):
    path, out = tmp_path / "log.csv", tmp_path / "out"
    log = a_log(steps=80)
    write_slamlog(log, path)
    before = path.read_text()
    result = slamgym("fit-noise", path, "--write", "--json", "--out", out)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert sorted(files_below(out)) == ["innovations.png", "summary.json"]
    after = path.read_text()
    changed = set(before.splitlines()) ^ set(after.splitlines())
    keys = {line.split(":")[0].removeprefix("# ") for line in changed}
    assert keys == {"motion_std", "measurement_std", "range_std_per_metre"}
    noise = settings_for(read_slamlog(path)).motion_std
    assert list(noise) == summary["runs"]["suggested"]["settings"]["motion_std"]
    assert "--motion-std" in summary["options"]


def test_writing_keeps_line_ends_and_byte_order_mark(tmp_path):
    path = tmp_path / "log.csv"
    text = "\ufeff# format: slamlog 1\r\n# motion_std: 1,1,1\r\nodometry,1,1,0,1\r\n"
    path.write_bytes(text.encode())
    log = read_slamlog(path)
    noise = {"motion_std": (0.1, 0.2, 0.3), "measurement_std": (0.01, 0.02)}
    options = {"range_std_per_metre": 0.03, "bearing_std_metres": 0.04}
    write_noise(path, settings_for(log, **noise, options=options))
    header = "\ufeff# format: slamlog 1\r\n# measurement_std: 0.01,0.02\r\n"
    header += "# range_std_per_metre: 0.03\r\n# bearing_std_metres: 0.04\r\n"
    rest = "# motion_std: 0.1,0.2,0.3\r\nodometry,1,1,0,1\r\n"
    assert path.read_bytes().decode() == header + rest


def test_a_diverging_fit_is_one_line_of_the_command_and_writes_nothing(tmp_path):
    rng, path, out = np.random.default_rng(0), tmp_path / "log.csv", tmp_path / "out"

    def absurd(readings):
        far = 10.0 ** rng.uniform(0, 6, len(readings))
        return np.column_stack([readings[:, 0], far])

    write_slamlog(with_readings(a_log(steps=20), absurd), path)
    before = path.read_bytes()
    result = slamgym("fit-noise", path, "--out", out, "--write")
    assert result.exit_code != 0
    assert result.stderr.splitlines()[-1].startswith("slamgym: ")
    assert "the fit diverges: under the most likely noise" in result.stderr
    assert not out.exists()
    assert path.read_bytes() == before


def test_bad_input_of_the_command_is_one_line_and_writes_nothing(tmp_path):
    path, out = tmp_path / "log.csv", tmp_path / "out"
    write_slamlog(SlamLog("empty", events=(MOVE,)), path)
    result = slamgym("fit-noise", path, "--out", out, "--write")
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1].startswith("slamgym: empty holds no scan")
    assert not out.exists()
    text = tmp_path / "data.txt"
    text.write_text("VERTEX2 0 0 0 0\n")
    refused = slamgym("fit-noise", text, "--write", "--out", out)
    assert refused.exit_code == 2
    assert not out.exists()
