import platform
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from slamgym.envs.rendering import write_video
from slamgym.sim_configs.scenario_files import replace_when_written


def moving_square(count=5, size=(40, 60)):
    for k in range(count):
        frame = np.full((*size, 3), 255, dtype=np.uint8)
        frame[10:20, 8 * k : 8 * k + 10] = (200, 30, 60)
        yield frame


def frames_of_gif(path):
    with Image.open(path) as gif:
        for k in range(gif.n_frames):
            gif.seek(k)
            yield np.asarray(gif.convert("RGB")), gif.info["duration"]


def test_gif_holds_every_frame_at_its_time(tmp_path):
    path = tmp_path / "run.gif"
    write_video(moving_square(), path, fps=10)
    shown = list(frames_of_gif(path))
    assert [duration for _, duration in shown] == [100] * 5
    for (frame, _), expected in zip(shown, moving_square(), strict=True):
        np.testing.assert_allclose(frame, expected, atol=3)


def test_a_file_named_by_a_process_that_cannot_be_stays(tmp_path):
    path = tmp_path / f".film.{10**20}@{platform.node()}-01234567.gif"
    path.write_text("of somebody")
    write_video(moving_square(), tmp_path / "film.gif")
    assert path.read_text() == "of somebody"


def test_the_rest_of_a_killed_film_goes_and_that_of_another_film_stays(tmp_path):
    code = "import sys; from slamgym.sim_configs import scenario_files as files\n"
    code += "with files.replace_when_written(sys.argv[1]) as partial:\n"
    code += "    partial.touch(); files.os.kill(files.os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", code, tmp_path / "run.gif"], check=False)
    (killed,) = tmp_path.iterdir()
    with replace_when_written(tmp_path / "other.gif") as written:
        written.touch()
        elsewhere = killed.with_name(killed.name.replace("@", "@another-"))
        elsewhere.touch()
        write_video(moving_square(), tmp_path / "film.gif")
        assert {*tmp_path.iterdir()} == {written, elsewhere, tmp_path / "film.gif"}


def test_gif_keeps_white_and_shows_colours_that_come_later(tmp_path):
    frames = [np.full((8, 8, 3), 255, np.uint8) for _ in range(2)]
    frames[0][7] = frames[1][7] = 255, 200, 0
    frames[1][2:5, 2:5] = 213, 94, 0
    write_video(frames, tmp_path / "run.gif")
    (_, _), (last, _) = frames_of_gif(tmp_path / "run.gif")
    np.testing.assert_array_equal(last[0, 0], [255, 255, 255])
    np.testing.assert_allclose(last[7, 0], [255, 200, 0], atol=8)
    np.testing.assert_allclose(last[3, 3], [213, 94, 0], atol=32)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(40, 60), (41, 63)])
def test_mp4_holds_every_frame(tmp_path, size):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
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
