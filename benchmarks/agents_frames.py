"""The rate at which Gymnasium's `RecordVideo` films active SLAM, encoding included.

The rate is in frames per second of CPU time, of this process and of the encoder, which
runs in a process of its own.
"""

import importlib.util
import os
import tempfile
from typing import Any

import gymnasium
from gymnasium.wrappers import RecordVideo
from interleaved import verdict

import slamgym  # noqa: F401 (registers the environments)

ID = "slamgym/ActiveSlam-v0"
GOAL = 60.0  # [frames/s]
STEPS = 150


def frames_line() -> tuple[str, int]:
    """Film an episode; return a line and the number of misses."""
    if importlib.util.find_spec("moviepy") is None:
        return "RecordVideo: moviepy is not installed", 0
    rate = max(_rate() for _ in range(3))
    word = verdict(rate, GOAL, at_least=True)
    line = f"RecordVideo, 600 x 600 pixels: {rate:.0f} frames/s, goal >= {GOAL:g}: "
    return line + word, int(word == "MISSED")


def _rate() -> float:
    """Film one episode of many steps; return frames per second."""
    with tempfile.TemporaryDirectory() as folder:
        env: gymnasium.Env[Any, Any] = RecordVideo(
            gymnasium.make(ID, render_mode="rgb_array", steps=STEPS, accuracy=1e-3),
            f"{folder}/films",
            episode_trigger=lambda _: True,
            disable_logger=True,
        )
        env.reset(seed=0)
        began = _cpu_seconds()
        ended, frames = False, 1
        while not ended:
            _, _, terminated, truncated, _ = env.step([0.3, 0.25])
            ended, frames = terminated or truncated, frames + 1
        env.close()
        return frames / (_cpu_seconds() - began)


def _cpu_seconds() -> float:
    return sum(os.times()[:4])
