import platform
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from slamgym.envs.rendering import write_video


def moving_square(count=5, size=(40, 60)):
    for k in range(count):
        frame = np.full((*size, 3), 255, dtype=np.uint8)
        frame[10:20, 8 * k : 8 * k + 10] = (200, 30, 60)
        yield frame


def frames_of_gif(path):
    with Image.open(path) as gif:
        for k in range(gif.n_frames):
            gif.seek(k)
            yield np.asarray(gif.convert("RGB")), gif.info


def test_gif_holds_every_frame_at_its_time(tmp_path):
    path = tmp_path / "run.GIF"
    write_video(moving_square(), path, fps=10)
    shown = list(frames_of_gif(path))
    assert [info["duration"] for _, info in shown] == [100] * 5
    assert shown[0][1]["loop"] == 0  # it repeats without end
    for (frame, _), expected in zip(shown, moving_square(), strict=True):
        np.testing.assert_allclose(frame, expected, atol=3)


def test_the_rest_of_a_killed_film_goes(tmp_path):
    ended = 2**22 + 7  # no process has so large a number
    (tmp_path / f".run.{ended}@{platform.node()}-01234567.gif").touch()
    write_video(moving_square(), tmp_path / "film.gif")
    assert [*tmp_path.iterdir()] == [tmp_path / "film.gif"]


def test_gif_keeps_white_and_shows_colours_that_come_later(tmp_path):
    frames = [np.full((8, 8, 3), 255, np.uint8) for _ in range(2)]
    frames[0][7] = frames[1][7] = 255, 200, 0
    frames[1][2:5, 2:5] = 213, 94, 0
    write_video(frames, tmp_path / "run.gif")
    (_, _), (last, _) = frames_of_gif(tmp_path / "run.gif")
    np.testing.assert_array_equal(last[0, 0], [255, 255, 255])
    np.testing.assert_allclose(last[7, 0], [255, 200, 0], atol=8)
    np.testing.assert_allclose(last[3, 3], [213, 94, 0], atol=32)


def test_mp4_is_padded_to_even_sizes_by_its_edges(tmp_path, monkeypatch):
    sent = []

    def write_frames(path, size, **options):
        Path(path).touch()
        sent.append((size, options))
        while True:
            sent.append((yield))

    ffmpeg = SimpleNamespace(write_frames=write_frames)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", ffmpeg)
    frames = [frame[:15] for frame in moving_square(3)]
    write_video(frames, tmp_path / "run.MP4", fps=12)
    asked, *padded = sent
    assert asked == ((60, 16), {"fps": 12, "macro_block_size": 2})
    for frame, found in zip(frames, padded, strict=True):
        np.testing.assert_array_equal(found, np.vstack([frame, frame[-1:]]))


@pytest.mark.slow
def test_mp4_holds_every_frame(tmp_path):
    ffmpeg, size = pytest.importorskip("imageio_ffmpeg"), (41, 63)
    path = tmp_path / "run.mp4"
    write_video(moving_square(7, size), path, fps=12)
    height, width = (n + n % 2 for n in size)
    command = [ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo"]
    decoded = subprocess.run(
        [*command, "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, height, width, 3)
    assert b"12 fps" in decoded.stderr
    for frame, expected in zip(frames, moving_square(7, size), strict=True):
        error = np.abs(frame[: size[0], : size[1]].astype(int) - expected)
        assert error.mean() < 4


def test_mp4_without_ffmpeg_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"pip install 'slamgym\[video\]'"):
        write_video(moving_square(), tmp_path / "run.mp4")


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_failure_leaves_the_former_file_and_nothing_else(tmp_path, suffix):
    path = tmp_path / f"run.{suffix}"
    path.write_text("former")

    def broken():
        yield from moving_square()
        raise RuntimeError("the simulation stopped")

    with pytest.raises(RuntimeError, match="the simulation stopped"):
        write_video(broken(), path)
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]


def never():
    pytest.fail("a frame was made")
    yield


@pytest.mark.parametrize("name", ["run.avi", "run", "gif"])
def test_unknown_suffix_is_refused_before_any_frame_is_made(tmp_path, name):
    with pytest.raises(ValueError, match=r"file must end in \.gif or \.mp4, got"):
        write_video(never(), tmp_path / name)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "at least one frame, got none"),
        (
            [np.zeros((4, 4, 4), np.uint8)],
            r"frame 0 must be uint8 of shape \(H, W, 3\)",
        ),
        ([np.zeros((4, 4, 3))], "got float64"),
        (
            [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 6, 3), np.uint8)],
            r"frame 1 must have shape \(4, 4, 3\), got \(4, 6, 3\)",
        ),
    ],
)
def test_wrong_frames_are_refused(tmp_path, frames, message):
    with pytest.raises(ValueError, match=message):
        write_video(frames, tmp_path / "run.gif")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fps", [0, -1, np.nan, np.inf])
def test_fps_must_be_positive(tmp_path, fps):
    with pytest.raises(ValueError, match="fps must be a finite number > 0"):
        write_video(moving_square(), tmp_path / "run.gif", fps=fps)


def test_missing_folder_is_named_before_any_frame_is_made(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"the folder of .*nowhere"):
        write_video(never(), tmp_path / "nowhere" / "run.gif")
