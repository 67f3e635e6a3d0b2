"""What Gymnasium's own tools do with every environment of ours that is registered."""

import json
import subprocess
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from comparison import same
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import RecordVideo

import slamgym  # noqa: F401 (registers the environments)
from slamgym.sim_configs import load_scenario

IDS = sorted(each for each in gym.registry if each.startswith("slamgym/"))
SCENARIO = "active_easy"  # one that every environment accepts, and nobody's default
PLAIN = json.loads(json.dumps(load_scenario(SCENARIO).model_dump()))
KEYWORDS = {
    "default": {},
    "name": {"scenario": SCENARIO},
    "mapping": {"scenario": PLAIN},
    "changes": {"scenario": SCENARIO, "steps": 7, "sensor": {"max_range": 2.5}},
}


def drive(env, shape=(2,), steps=9):
    """Return all that is told from a reset on, with actions that go on and turn."""
    told = [env.reset(seed=5)]
    for speed in np.linspace(0.1, 0.6, steps):
        told.append(env.step(np.broadcast_to([speed, 0.2], shape)))
    env.close()
    return told


@pytest.mark.parametrize("each", IDS)
def test_gymnasiums_checker_is_silent(each):
    check_env(gym.make(each).unwrapped)  # pytest makes an error of a warning


# --- specifications ---


@pytest.mark.parametrize("keywords", KEYWORDS)
@pytest.mark.parametrize("each", IDS)
def test_a_spec_written_as_json_makes_the_same_world(each, keywords):
    env = gym.make(each, **KEYWORDS[keywords])
    written = env.spec.to_json()
    json.loads(written)
    rebuilt = gym.make(EnvSpec.from_json(written))
    assert rebuilt.spec == env.spec
    assert rebuilt.unwrapped.scenario == env.unwrapped.scenario
    if keywords == "changes":
        assert rebuilt.unwrapped.scenario.steps == 7
        assert rebuilt.unwrapped.scenario.sensor.max_range == 2.5
    same(drive(rebuilt, steps=6), drive(env, steps=6))


@pytest.mark.parametrize("keywords", KEYWORDS)
@pytest.mark.parametrize("each", IDS)
def test_a_spec_of_many_worlds_written_as_json_makes_the_same_worlds(each, keywords):
    worlds = gym.make_vec(each, 3, **KEYWORDS[keywords])
    rebuilt = gym.make_vec(EnvSpec.from_json(worlds.spec.to_json()))
    assert type(rebuilt) is type(worlds)
    same(drive(rebuilt, (3, 2), 6), drive(worlds, (3, 2), 6))


# --- other processes ---


@pytest.mark.slow
@pytest.mark.parametrize("each", IDS)
def test_workers_that_know_nothing_but_the_id_make_the_same_worlds(each):
    """Spawned, not forked: the package named in the id is all that registers it."""
    changes = {"scenario": SCENARIO, "steps": 4}
    make = partial(gym.make, f"slamgym:{each}", **changes)
    workers = AsyncVectorEnv([make], context="spawn")
    here = SyncVectorEnv([partial(gym.make, each, **changes)])
    same(drive(workers, (1, 2)), drive(here, (1, 2)))


# --- videos ---

# One frame at reset and one a step, 9. At 6 or 8 frames, say, moviepy's sum of 1 / fps
# comes out below what it is, and the last frame is lost.
STEPS = 8


def decoded(path):
    """Return the frames of a video and what ffmpeg says of it."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="decodes the video")
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo"]
    done = subprocess.run(
        [*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    return np.frombuffer(done.stdout, np.uint8), done.stderr.decode()


@pytest.mark.slow
@pytest.mark.parametrize("each", IDS)
def test_gymnasium_records_a_video_that_shows_the_episode(each, tmp_path):
    pytest.importorskip("moviepy", reason="RecordVideo needs gymnasium[other]")
    changes = {"scenario": SCENARIO, "steps": STEPS, "render_mode": "rgb_array"}
    twin = gym.make(each, **changes)
    env = RecordVideo(
        gym.make(each, **changes), str(tmp_path / "new"), name_prefix="drive"
    )
    shown = []
    for world in (env, twin):
        world.reset(seed=1)
        ended = False
        while not ended:
            if world is twin:
                shown.append(world.render())
            ended = any(world.step([0.6, 0.4])[2:4])
    shown.append(twin.render())
    env.close()
    twin.close()

    pixels, description = decoded(tmp_path / "new" / "drive-episode-0.mp4")
    frames = pixels.reshape(-1, *shown[0].shape)
    assert len(frames) == len(shown) == STEPS + 1
    assert f"{env.metadata['render_fps']} fps" in description
    for k, frame in enumerate(frames.astype(int)):
        errors = [np.abs(frame - moment).mean() for moment in shown]
        assert np.argmin(errors) == k  # no other moment, nor a blank
        assert errors[k] < 4


@pytest.mark.slow
def test_gymnasium_records_a_video_of_many_worlds(tmp_path):
    vector = pytest.importorskip("gymnasium.wrappers.vector")
    if not hasattr(vector, "RecordVideo"):
        pytest.skip("this Gymnasium has no RecordVideo for vectors")
    pytest.importorskip("moviepy", reason="RecordVideo needs gymnasium[other]")
    changes = {"steps": STEPS, "render_mode": "rgb_array"}
    worlds = gym.make_vec("slamgym/LandmarkWorld-v0", 2, **changes)
    folder = tmp_path / "new"
    env = vector.RecordVideo(worlds, str(folder), video_aspect_ratio=(2, 1))
    drive(env, (2, 2), STEPS + 1)
    (path,) = folder.glob("*episode-0.mp4")
    frames = decoded(path)[0].reshape(STEPS + 1, 600, 2 * 600, 3)
    for half in np.split(frames.astype(int), 2, axis=2):
        assert (np.diff(half, axis=0) != 0).any(axis=(1, 2, 3)).all()
