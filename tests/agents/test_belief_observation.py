"""What an agent sees of a belief: right, bounded, and never the truth."""

import runpy
from pathlib import Path

import gymnasium as gym
import numpy as np
import numpy_belief_features as twin
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from numpy_belief_features import (
    marginals_of,
    on_log_scale,
    relative_landmarks,
    relative_spreads,
)

import slamgym  # noqa: F401 (registers the environments)
from slamgym.agents import BeliefObservation, BeliefObservationVector
from slamgym.agents.belief_features import (
    belief_features,
    belief_storage,
    world_bounds,
    write_features,
)
from slamgym.agents.belief_features import on_log_scale as log_scale_of_one
from slamgym.estimator import EkfSlam, make_batch, make_estimator
from slamgym.estimator.models.sensors import BEARING_RANGE
from slamgym.sim_configs import load_scenario

ID = "slamgym/LandmarkWorld-v0"
SPIN = np.array([0.6, 0.3])


def world(scenario="loop", **changes):
    return gym.make(ID, scenario=scenario, **changes)


def drive(env, steps, seed=0):
    observation, _ = env.reset(seed=seed)
    for _ in range(steps):
        observation, *_ = env.step(SPIN)
    return observation


@pytest.fixture(scope="module")
def belief():
    """A belief with strong correlations, its last landmark still unseen."""
    env = BeliefObservation(world(start={"std": [0.1, 0.2, 0.1]}), "ekf")
    drive(env, 30)
    assert not env.beliefs.mapped.all()
    return env.beliefs


def relative(state):
    """Compute every landmark in the robot's frame, of one state vector."""
    (x, y, heading), points = state[:3], state[3:].reshape(-1, 2)
    turn = np.array(
        [[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]]
    )
    return (points - (x, y)) @ turn.T


def test_landmarks_are_turned_into_the_frame_of_the_robot(belief):
    expected = relative(belief.means[0]) * belief.mapped[0][:, None]
    computed = relative_landmarks(marginals_of(belief))[0]
    np.testing.assert_allclose(computed, expected, atol=1e-12)


def test_their_covariance_is_that_of_numeric_derivatives(belief):
    mean, step = belief.means[0], 1e-6
    steps = step * np.eye(len(mean))
    columns = [relative(mean + each) - relative(mean - each) for each in steps]
    jacobian = np.stack(columns, axis=-1) / (2 * step)
    aa, ab, bb = (part[0] for part in relative_spreads(marginals_of(belief)))
    for row in np.flatnonzero(belief.mapped[0]):
        spread = jacobian[row] @ belief.covariances[0] @ jacobian[row].T
        np.testing.assert_allclose(
            [[aa[row], ab[row]], [ab[row], bb[row]]], spread, rtol=1e-6, atol=1e-12
        )
    assert not aa[~belief.mapped[0][None][0]].any()


NOISE = {"motion_std": (0.3, 0.1, 0.2), "measurement_std": (0.1, 0.2)}
FLOOR = (-12.0, -7.0, 9.0, 8.0)
RUNS, LANDMARKS, STEPS = 7, 9, 12


@pytest.fixture(scope="module", params=["ekf", "invariant"])
def batch(request):
    """Filters that met their landmarks in any order; one met none, one has turned."""
    rng = np.random.default_rng(4)
    batch = make_batch(request.param, runs=RUNS, landmarks=LANDMARKS, **NOISE)
    batch.reset(rng.uniform(-6, 6, (RUNS, 3)), (0.2, 0.1, 0.3))
    visible = rng.random((RUNS, STEPS, LANDMARKS)) < 0.12
    visible[0] = False
    readings = np.stack(
        [rng.uniform(-3, 3, visible.shape), rng.uniform(1, 9, visible.shape)], axis=-1
    )
    odometry = rng.uniform((0.0, -0.5), (1.0, 0.5), (RUNS, STEPS, 2))
    odometry[1, :, 1] = 1.0
    batch.run(odometry, readings, visible)
    slots = batch.storage().slots
    assert not (slots[0] >= 0).any()
    assert any((np.diff(row[row >= 0]) < 0).any() for row in slots)
    assert np.abs(batch.storage().means[1, 2]) > 2 * np.pi
    return batch


def agree(features, expected):
    assert list(features) == list(expected)
    for key, rows in features.items():
        assert rows.dtype == expected[key].dtype
        np.testing.assert_allclose(rows, expected[key], rtol=0, atol=1e-12)


def test_the_compiled_pass_agrees_with_its_slow_twin(batch):
    expected = twin.belief_features(marginals_of(batch.beliefs()), FLOOR)
    assert (expected["belief_mask"].sum(axis=1) > 1).any()
    agree(belief_features(batch.storage(), FLOOR), expected)


def test_the_compiled_pass_agrees_with_its_slow_twin_at_the_bounds(batch):
    tiny = (-0.1, -0.2, 0.1, 0.3)  # all is outside
    expected = twin.belief_features(marginals_of(batch.beliefs()), tiny)
    assert np.abs(expected["belief_landmarks"]).max() == 1.0
    agree(belief_features(batch.storage(), tiny), expected)
    certain = make_batch("ekf", runs=2, landmarks=0, **NOISE)  # all variances are 0
    expected = twin.belief_features(marginals_of(certain.beliefs()), FLOOR)
    assert not expected["belief_pose_std"].any()
    agree(belief_features(certain.storage(), FLOOR), expected)


def test_every_number_is_written_where_nothing_is_mapped(batch):
    rows = belief_features(batch.storage(), FLOOR)
    shown = [
        np.full(row.shape, True if row.dtype == bool else np.nan)
        for row in rows.values()
    ]
    write_features(*batch.storage(), FLOOR, tuple(shown))
    for key, written in zip(rows, shown, strict=True):
        np.testing.assert_array_equal(written, rows[key])
        if "landmark" in key:
            assert not written[~rows["belief_mask"]].any()


def test_features_do_not_depend_on_how_a_belief_is_stored(batch):
    """A batch, and each of its beliefs by itself with its landmarks in rows."""
    many = belief_features(batch.storage(), FLOOR)
    for run in range(RUNS):
        rows = belief_storage(batch.belief(run), LANDMARKS, by_id=True)
        alone = belief_features(rows, FLOOR)
        for key, values in many.items():
            np.testing.assert_array_equal(values[run], alone[key][0])


def test_the_pose_is_spread_in_the_frame_of_the_robot():
    env = BeliefObservation(world(start={"std": [0.1, 0.2, 0.1]}), "ekf")
    observation = drive(env, 25)
    cov, heading = env.belief.pose_covariance, env.belief.pose[2]
    turn = np.eye(3)
    turn[:2, :2] = [
        [np.cos(heading), np.sin(heading)],
        [-np.sin(heading), np.cos(heading)],
    ]
    turned = turn @ cov @ turn.T
    std = np.sqrt(np.diag(turned))
    np.testing.assert_allclose(observation["belief_pose_std"], on_log_scale(std))
    correlation = (turned / np.outer(std, std))[[0, 0, 1], [1, 2, 2]]
    np.testing.assert_allclose(observation["belief_pose_correlation"], correlation)
    left, bottom, right, top = world_bounds(env.scenario)
    x, y = env.belief.pose[:2]
    expected = [
        (2 * x - left - right) / (right - left),
        (2 * y - bottom - top) / (top - bottom),
        np.cos(heading),
        np.sin(heading),
    ]
    np.testing.assert_allclose(observation["belief_pose"], np.clip(expected, -1, 1))


def test_what_a_landmark_is_off_in_the_map_is_its_worst_direction(belief):
    env = BeliefObservation(world(), "ekf")
    observation = drive(env, 25)
    for row, landmark in enumerate(env.belief.landmark_ids):
        spread = env.belief.landmark_covariances[row]
        worst = np.sqrt(np.linalg.eigvalsh(spread)[-1])
        seen = observation["belief_landmark_map_std"][landmark]
        assert seen == pytest.approx(float(on_log_scale(worst)), abs=1e-9)


@pytest.mark.parametrize("preset", ["six_landmarks", "corridor", "hidden_identities"])
def test_gymnasiums_checker_finds_nothing_to_warn_of(preset):
    options = {"max_landmarks": 60} if preset == "hidden_identities" else {}
    estimator = MatchesByPlace if preset == "hidden_identities" else "invariant"
    env = BeliefObservation(world(preset).unwrapped, estimator, **options)
    with pytest.warns(UserWarning, match="different from the unwrapped") as warned:
        check_env(env, skip_render_check=True)
    assert len(warned) == 1  # of being a wrapper, and nothing else


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["six_landmarks", "loop", "slippery", "standing"])
def test_every_observation_of_an_episode_lies_in_its_space(preset):
    env = BeliefObservation(world(preset), "ekf")
    observation, _ = env.reset(seed=0)
    for _ in range(min(env.scenario.steps, 150)):
        assert observation in env.observation_space
        assert list(observation) == list(env.observation_space)
        observation, *_ = env.step(env.action_space.sample())


def test_the_belief_does_not_know_the_truth(monkeypatch):
    """The world's truth is replaced by nonsense wherever it can be asked for."""
    honest = BeliefObservation(world(), "ekf")
    deceived = BeliefObservation(world(), "ekf")
    unwrapped = deceived.unwrapped
    step, reset = unwrapped.step, unwrapped.reset

    def without_truth(answer):
        *rest, info = answer
        return (*rest, {**info, "pose": np.full(3, 1e6), "collision": True})

    def blind_reset(*, seed=None, options=None):
        return without_truth(reset(seed=seed, options=options))

    monkeypatch.setattr(unwrapped, "step", lambda a: without_truth(step(a)))
    monkeypatch.setattr(unwrapped, "reset", blind_reset)
    for attribute in ("landmarks", "pose"):
        monkeypatch.setattr(
            type(unwrapped), attribute, property(lambda _: np.full((20, 2), np.nan))
        )
    seen, blind = drive(honest, 20), drive(deceived, 20)
    for key in seen:
        np.testing.assert_array_equal(seen[key], blind[key])


@pytest.mark.parametrize(
    ("name", "label", "growth"),
    [("loop", "invariant", 0.0), ("coarse_loop", "ekf", 0.1)],
)
def test_the_belief_is_that_of_a_filter_fed_by_hand(name, label, growth):
    env = BeliefObservation(world(name), label)
    scenario = env.scenario
    slam = make_estimator(
        label,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        sensor=BEARING_RANGE.with_noise(range_std_per_metre=growth),
        noise_at_rest=scenario.motion.noise_at_rest,
    )
    observation, _ = env.reset(seed=3)
    slam.reset(env.unwrapped.start_estimate, scenario.start.std)
    for _ in range(15):
        seen = np.flatnonzero(observation["mask"])
        slam.update(observation["landmarks"][seen], seen)
        np.testing.assert_array_equal(env.belief.covariance, slam.belief().covariance)
        observation, *_ = env.step(SPIN)
        slam.predict(observation["odometry"])


def test_an_episode_ends_as_without_the_wrapper():
    env = BeliefObservation(world(steps=2), "ekf")
    env.reset(seed=0)
    assert [env.step(SPIN)[2:4] for _ in range(2)] == [(False, False), (False, True)]


def test_a_filter_without_the_noise_of_the_world_is_refused():
    with pytest.raises(ValueError, match="does not accept range_std_per_metre"):
        BeliefObservation(world("coarse_loop"), MatchesByPlace)


class MatchesByPlace:
    """Associates by order of sight: rubbish, but of its own identities."""

    def __init__(self, motion_std, measurement_std):
        self._slam = EkfSlam(motion_std, measurement_std)

    def reset(self, pose, pose_std):
        self._slam.reset(pose, pose_std)
        self._next = 100

    def predict(self, odometry, dt=1.0):
        self._slam.predict(odometry, dt)

    def update(self, measurements, landmark_ids=None):
        assert landmark_ids is None
        ids = range(self._next, self._next + len(measurements))
        self._next += len(measurements) if self._next < 104 else 0
        return self._slam.update(measurements, ids)

    def belief(self):
        return self._slam.belief()


def test_an_estimator_with_identities_of_its_own_fills_the_rows_in_its_order():
    hidden = world("hidden_identities")
    env = BeliefObservation(hidden, MatchesByPlace, max_landmarks=60)
    observation, _ = env.reset(seed=0)
    count = int(observation["mask"].sum())
    assert count > 0
    assert (observation["belief_mask"] == (np.arange(60) < count)).all()


def test_a_map_that_outgrows_its_rows_is_refused():
    env = BeliefObservation(world("hidden_identities"), MatchesByPlace, max_landmarks=1)
    with pytest.raises(
        ValueError, match=r"max_landmarks must leave room .* got 1 rows"
    ):
        drive(env, 30)


def test_more_rows_than_the_world_has_landmarks_stay_empty():
    env = BeliefObservation(world(), "ekf", max_landmarks=25)
    observation = drive(env, 5)
    assert observation["belief_landmarks"].shape == (25, 2)
    assert not observation["belief_mask"][20:].any()


@pytest.mark.parametrize("method", ["reset", "predict", "update", "belief"])
def test_an_estimator_that_lacks_a_method_is_refused_by_that_name(method):
    class Lacking(EkfSlam):
        pass

    made = Lacking((0.1, 0.1, 0.1), (0.1, 0.1))
    setattr(Lacking, method, None)
    for estimator in (made, lambda **_: made):
        with pytest.raises(TypeError, match=rf"Lacking has no method {method}\(\)"):
            BeliefObservation(world(), estimator)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, r"Wrong\.belief\(\) must return a belief with pose.* without pose"),
        ("nan", r"Wrong\.belief\(\) must be finite"),
        ("small", r"Wrong\.belief\(\) must have a covariance of shape"),
    ],
)
def test_a_belief_that_breaks_the_protocol_is_refused(answer, message):
    class Wrong(EkfSlam):
        def belief(self):
            if answer is None:
                return None
            belief = super().belief()
            wrong = belief.covariance * np.nan if answer == "nan" else np.eye(3)
            object.__setattr__(belief, "covariance", wrong)
            return belief

    with pytest.raises((TypeError, ValueError), match=message):
        drive(BeliefObservation(world(), Wrong), 1)


MADE = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))


@pytest.mark.parametrize(
    ("name", "estimator", "options", "message"),
    [
        (ID, "invariat", {}, "did you mean 'invariant'"),
        (ID, "ekf", {"max_landmarks": 19}, "max_landmarks must be >= the 20 .* got 19"),
        (ID, MADE, {"estimator_options": {"gate_probability": 0.9}},
         "estimator_options must be empty"),
        ("CartPole-v1", "ekf", {}, "env must be a landmark world"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused(name, estimator, options, message):
    env = world() if name == ID else gym.make(name)
    with pytest.raises(ValueError, match=message):
        BeliefObservation(env, estimator, **options)


@pytest.mark.parametrize(
    ("scenario", "estimator", "message"),
    [
        ("loop", "unscented", "cannot run in batches"),
        (
            "loop",
            EkfSlam,
            "estimator must be a name for .* that register_estimator gives",
        ),
        (
            "hidden_identities",
            EkfSlam,
            "estimator must be a name for .* that register_estimator gives",
        ),
    ],
)
def test_an_estimator_that_many_worlds_cannot_take_is_refused(
    scenario, estimator, message
):
    vector = gym.make_vec(ID, 2, scenario=scenario)
    with pytest.raises(ValueError, match=message):
        BeliefObservationVector(vector, estimator)


def test_the_wrapper_survives_a_spec_written_as_json():
    options = {"iterations": 2}
    env = BeliefObservation(world(), "invariant", estimator_options=options)
    rebuilt = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(rebuilt, BeliefObservation)
    ours, theirs = drive(env, 5), drive(rebuilt, 5)
    for key in ours:
        np.testing.assert_array_equal(ours[key], theirs[key])


@pytest.mark.slow
def test_frames_show_the_belief():
    plain, shown = (world(render_mode="rgb_array") for _ in range(2))
    shown = BeliefObservation(shown, "ekf")
    for env in (plain, shown):
        drive(env, 3)
    assert (plain.render() != shown.render()).any()
    plain.close()
    shown.close()


def same(batch, world, observation):
    assert list(batch) == list(observation)
    for key in batch:
        np.testing.assert_array_equal(batch[key][world], observation[key])


START = {"std": [0.1, 0.1, 0.1], "drawn": "estimate"}
CLUTTER = {"steps": 9, "sensor": {"clutter": 2.0}, "start": START}
GROWING = {"dropout": 0.2, "range_std_per_metre": 0.1}
OTHER = {"estimator_options": {"range_std_per_metre": 0.02}, "max_landmarks": 31}
CASES = [
    ("loop", {"steps": 9, "start": {"std": [0.1, 0.1, 0.1]}}, "ekf", {}),
    ("corridor", {"steps": 7, "sensor": GROWING}, "invariant", OTHER),
    ("active_easy", {"steps": 8, "start": START}, "first_estimates", {}),
    ("hidden_identities", CLUTTER, "invariant", {}),
]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize(("scenario", "changes", "estimator", "options"), CASES)
def test_a_vector_of_worlds_shows_what_single_worlds_show(
    mode, scenario, changes, estimator, options
):
    vector = gym.make_vec(ID, 3, scenario=scenario, autoreset_mode=mode, **changes)
    vector = BeliefObservationVector(vector, estimator, **options)
    envs = [world(scenario, **changes) for _ in range(3)]
    envs = [BeliefObservation(env, estimator, **options) for env in envs]
    batch, _ = vector.reset(seed=5)
    for k, env in enumerate(envs):
        same(batch, k, env.reset(seed=5 + k)[0])
    ended = np.zeros(3, dtype=bool)
    for step, action in enumerate(np.random.default_rng(0).uniform(-1, 1, (22, 3, 2))):
        if mode == "Disabled":
            ended |= [False, step == 3, False]  # worlds out of step
            reset_some(vector, envs, ended)
        elif step > 12 and ended.any():  # at the second end, by hand
            reset_some(vector, envs, ended)
            ended[:] = False
        batch, _, terminated, truncated, infos = vector.step(action)
        assert batch in vector.observation_space
        for k, env in enumerate(envs):
            begins = mode == "NextStep" and ended[k]
            observation = env.reset()[0] if begins else env.step(action[k])[0]
            if "final_obs" in infos and infos["_final_obs"][k]:
                last = infos["final_obs"][k]
                same({key: [last[key]] for key in last}, 0, observation)
                observation = env.reset()[0]
            same(batch, k, observation)
        ended = terminated | truncated
    vector.close()


def reset_some(vector, envs, worlds):
    if worlds.any():
        batch, _ = vector.reset(options={"reset_mask": worlds})
        for k in np.flatnonzero(worlds):
            same(batch, k, envs[k].reset()[0])


def test_a_log_scale_spans_a_millimetre_to_ten_metres():
    std = np.array([0.0, 1e-3, 1e-2, 10.0, 1e9])
    values = [log_scale_of_one(each) for each in std.tolist()]
    np.testing.assert_allclose(values, [0, 0, 0.25, 1, 1], atol=1e-12)
    np.testing.assert_allclose(on_log_scale(std), values, atol=1e-12)


def test_a_world_without_walls_is_bounded_by_its_landmarks_and_its_path():
    left, bottom, right, top = world_bounds(load_scenario("six_landmarks"))
    assert left <= 0 <= right
    assert (right, top) >= (11.0, 14.0)
    assert bottom < top


def test_a_belief_in_rows_keeps_every_number():
    slam = EkfSlam((0.1, 0.1, 0.1), (0.1, 0.1))
    slam.predict((1.0, 0.2))
    slam.update([(0.3, 2.0), (-0.3, 3.0)], landmark_ids=[4, 1])
    rows = belief_storage(slam.belief(), 5, by_id=True).beliefs()
    state = [0, 1, 2, 11, 12, 5, 6]
    np.testing.assert_array_equal(rows.means[0][state], slam.belief().mean)
    kept = rows.covariances[0][np.ix_(state, state)]
    np.testing.assert_array_equal(kept, slam.belief().covariance)
    assert np.count_nonzero(rows.covariances) == np.count_nonzero(kept)


@pytest.mark.slow
def test_the_example_shows_that_going_home_bounds_the_uncertainty_of_the_place(
    tmp_path, monkeypatch, capsys
):
    example = next(Path(__file__).parents[2].glob("examples/*belief_in_the_loop.py"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(example)])
    runpy.run_path(str(example), run_name="__main__")
    on, home, *_ = capsys.readouterr().out.splitlines()
    assert float(on.split()[-2]) > float(home.split()[-2])
    assert (tmp_path / "results" / "08_belief_in_the_loop.png").exists()


CONFIRM = {"confirm": [1, 1]}


@pytest.mark.parametrize(
    ("management", "most"), [(True, 6), (CONFIRM, 6), ({**CONFIRM, "capacity": 4}, 4)]
)
def test_a_managed_map_never_outgrows_its_rows_or_its_capacity(management, most):
    env = world("hidden_identities", sensor={"clutter": 3.0}, steps=60)
    options = {"management": management}
    env = BeliefObservation(env, "ekf", estimator_options=options, max_landmarks=6)
    assert drive(env, 60)["belief_mask"].sum() == most
    assert len(env.belief.landmark_ids) == most
