"""What all filters for growing maps promise alike: honest, resumable, exact removal."""

import hashlib
import pickle
from pathlib import Path

import comparison
import forked
import numpy as np
import pytest
from scipy.stats import chi2

from slamgym.estimator import make_estimator
from slamgym.evaluation.nees import normalised_squared_error, state_nees
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

CITY = load_scenario("city")
NOISE = {"motion_std": CITY.motion.std, "measurement_std": CITY.sensor.std}


def city(columns, rows, steps):
    """A corner of the preset, of which the robot drives round every block."""
    blocks = {"columns": columns, "rows": rows}
    return CITY.with_changes(steps=steps, landmarks=blocks, controls=blocks)


# --- honesty: 64 landmarks, four blocks, each a loop closed ---

RUNS = 6
FOUR_BLOCKS = city(2, 2, 258)
EXACT = {
    "compressed[local_size=20]": "ekf",
    "compressed[base=invariant,local_size=20]": "invariant",
}
SPARSE = {"active_bound": 12, "dense_limit": 12}
OTHERS = {"submaps": {"submap_size": 20}, "sparse_information": SPARSE}


@pytest.fixture(scope="module")
def results():
    results = monte_carlo(FOUR_BLOCKS, (*EXACT.values(), *EXACT), RUNS)
    assert not results.failed.any()
    assert (results.state_dof == 3 + 2 * 64).all()  # everything is mapped
    return results


@pytest.mark.slow
@pytest.mark.parametrize(("label", "full"), EXACT.items())
def test_compressed_has_every_nees_of_its_base(results, label, full):
    one, other = results.sel(estimator=label), results.sel(estimator=full)
    for name in results.data_vars:
        if "nees" in name or name == "nis":
            np.testing.assert_allclose(one[name], other[name], rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(one.nis_dof, other.nis_dof)


def in_band(total, dof):
    """Whether a sum of independent NEES is where 99.9 % of consistent ones are."""
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    return low < total < high


@pytest.mark.slow
@pytest.mark.parametrize("label", EXACT.values())
def test_in_a_city_the_final_belief_of_the_full_filter_is_honest(results, label):
    one = results.sel(estimator=label)
    for name, dof in (("state_nees_invariant", 131), ("pose_nees_invariant", 3)):
        final = one[name] if name.startswith("state") else one[name].isel(step=-1)
        assert in_band(float(final.sum()), dof * RUNS)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), OTHERS.items())
def test_in_a_city_the_final_belief_is_honest(name, options):
    runs = simulate_runs(FOUR_BLOCKS, RUNS, 0)
    ids = list(range(runs.landmarks.shape[1]))
    totals = np.zeros(2)
    for run in range(RUNS):
        slam = of_city(name, **options)
        driven(slam, runs, run, lambda _, seen: (seen, seen))
        belief = slam.belief(ids)  # everything is mapped
        truth = np.r_[runs.true_poses[run, -1], runs.landmarks[run].ravel()]
        for k, size in enumerate((len(truth), 3)):
            mean, covariance = belief.mean[:size], belief.covariance[:size, :size]
            totals[k] += state_nees(truth[:size], mean, covariance, frame="invariant")
    assert in_band(totals[0], 131 * RUNS)
    assert in_band(totals[1], 3 * RUNS)


# --- stopped at any step and continued ---

TIDY = {
    "trust_ids": False,
    "confirm": (2, 4),
    "view": {"max_range": 5.0},
    "remove_after": 6,
    "merge_within": 1.0,
    "capacity": 45,
}
WAYS = {
    "ekf, managed": ("ekf", {"management": TIDY}),
    "compressed": ("compressed", {"local_size": 20}),
    "compressed invariant": ("compressed", {"local_size": 20, "base": "invariant"}),
    "compressed, managed": ("compressed", {"local_size": 20, "management": TIDY}),
    "sparse_information": ("sparse_information", SPARSE),
    "sparse_information, managed": (
        "sparse_information",
        SPARSE | {"management": TIDY},
    ),
    "submaps": ("submaps", {"submap_size": 20}),
    "submaps, managed": ("submaps", {"submap_size": 20, "management": TIDY}),
    "submaps in a folder": ("submaps", {"submap_size": 20, "folder": "submaps"}),
}
EVERY, ONWARD = 23, 10  # calls from one stop to the next, and after each


def made(way, folder="."):
    """Make a filter; its submaps, if on disk, lie in the folder."""
    name, options = WAYS[way]
    if "folder" in options:
        options = options | {"folder": Path(folder) / options["folder"]}
    return of_city(name, **options)


def of_city(name, **options):
    """Make a filter with the noise of the city."""
    return make_estimator(name, **NOISE, **options)


def renaming():
    """Make a function that calls landmarks by another name once long out of sight."""
    names, last = {}, {}

    def called(step, ids):
        for i in ids:
            if step - last.get(i, step) > 8:
                names[i] = 1000 * (step + 1) + i
            last[i] = step
        return ids, [names.get(i, i) for i in ids]

    return called


def calls_of(way, steps=220):
    """Return what a filter is told on a drive past 80 landmarks, call by call.

    To a managed one each scan also has a reading of nothing, and landmarks that it has
    not seen for long come back under other names.
    """
    runs = simulate_runs(city(5, 1, steps), 1, 0)
    rng, calls, called = np.random.default_rng(0), [], renaming()
    for step in range(steps + 1):
        if step:
            calls.append(("predict", runs.odometry[0, step]))
        ids = np.flatnonzero(runs.visible[0, step]).tolist()
        readings = runs.measurements[0, step, ids]
        if "managed" in way:
            ids = [*called(step, ids)[1], -1 - step]
            readings = np.vstack([readings, rng.uniform((-3.0, 1.0), (3.0, 5.0))])
        calls.append(("update", readings, ids))
    return calls


def tell(slam, calls):
    """Make the calls; return the reports."""
    reports = [getattr(slam, name)(*arguments) for name, *arguments in calls]
    return [report for report in reports if report is not None]


def digest(slam):
    """Sum up a filter's state and belief, to the last bit."""
    belief = slam.belief()
    bits = repr((comparison.digest(slam), belief.mean.tobytes()))
    total = hashlib.sha256(bits.encode() + belief.covariance.tobytes())
    return total.hexdigest()


def stopped(way, folder):
    """Run through; return the states on the way, and what came of each later."""
    calls, slam = calls_of(way), made(way, folder)
    stops = range(EVERY, len(calls) - ONWARD, EVERY)
    states, later, reports, near = {}, [], [], set()
    for k, call in enumerate(calls):
        if k in stops:
            states[k] = slam.state_dict()
        if k - ONWARD in stops:
            later.append(digest(slam))
        reports += tell(slam, [call])
        near.add(getattr(slam, "local_ids", ()))
    assert len(states) > 15
    for kind in ("confirmed_ids", "removed_ids", "merged_ids"):
        assert any(getattr(report, kind) for report in reports) == ("managed" in way)
    assert "managed" in way or len(near) > 3  # local maps came and went
    return states, later


def continued(way, folder, states):
    """Go on from each state for a while; return what came of it."""
    calls, later = calls_of(way), []
    for stop, state in states.items():
        slam = made(way, folder)
        slam.load_state_dict(state)
        tell(slam, calls[stop : stop + ONWARD])
        later.append(digest(slam))
    return later


def all_continued(folder):
    """Go on from the states of every way; return what came of it, or the error."""
    found = {}
    for way in WAYS:
        try:
            states = pickle.loads((folder / way / "states.pickle").read_bytes())
            found[way] = continued(way, folder / way, states)
        except Exception as error:
            found[way] = repr(error)
    return found


@pytest.fixture(scope="module")
def both_processes(tmp_path_factory):
    """What came of each state, here and in another process, by way."""
    folder, here = tmp_path_factory.mktemp("states"), {}
    for way in WAYS:
        (folder / way).mkdir()
        states, here[way] = stopped(way, folder / way)
        (folder / way / "states.pickle").write_bytes(pickle.dumps(states))
    return here, forked.result_of(all_continued, folder)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_stopped_after_any_call_it_goes_on_in_another_process(both_processes, way):
    here, there = both_processes
    assert there[way] == here[way]


# --- merging true duplicates ---

MANAGED = {
    "compressed": ("compressed", {"base": "invariant", "local_size": 16}),
    "sparse_information": ("sparse_information", {"active_bound": 8, "dense_limit": 8}),
    "submaps": ("submaps", {"submap_size": 16}),
}
DRIVES, STEPS = 4, 128  # past two blocks, round each of which a loop is closed


def driven(slam, runs, run, called):
    """Drive one run, the scans named by a function; return what is merged."""
    merged = []
    for step, visible in enumerate(runs.visible[run]):
        if step:
            slam.predict(runs.odometry[run, step])
        shown, ids = called(step, np.flatnonzero(visible).tolist())
        merged += slam.update(runs.measurements[run, step, shown], ids).merged_ids
    return merged


def tidied(slam, runs, run, called):
    """Drive one run as above; NEES and its degrees, merges."""
    merged = driven(slam, runs, run, called)
    belief = slam.belief()
    places = runs.landmarks[run, [i % 1000 for i in belief.landmark_ids]]
    error = belief.error(runs.true_poses[run, -1], places)
    nees = normalised_squared_error(error, belief.error_covariance())
    return float(nees), len(error), merged


@pytest.mark.slow
@pytest.mark.parametrize("way", MANAGED)
def test_merging_true_duplicates_keeps_a_growing_map_honest(way):
    name, options = MANAGED[way]
    runs = simulate_runs(city(2, 1, STEPS), DRIVES, 0)
    total, freedom = 0.0, 0
    for run in range(DRIVES):
        slam = of_city(name, management={"merge_within": 1.0}, **options)
        nees, dof, merged = tidied(slam, runs, run, renaming())
        assert len(merged) > 10
        assert all(kept % 1000 == gone % 1000 for kept, gone in merged)
        total, freedom = total + nees, freedom + dof
    assert in_band(total, freedom)
