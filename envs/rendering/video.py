"""Videos from frames: GIF by Pillow, MP4 by ffmpeg."""

from collections.abc import Iterable, Iterator
from importlib import import_module
from itertools import chain
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image

from ...arrays import ImageArray
from ...sim_configs.scenario_files import remove_unfinished, replace_when_written


def check_video(path: str | Path, fps: float = 30.0) -> None:
    """Refuse a video that `write_video` could not write, before its frames are made.

    Raises
    ------
    ValueError
        For a suffix other than .gif and .mp4, or an fps that is not positive.
    ImportError
        For .mp4 without imageio-ffmpeg.
    FileNotFoundError
        If the folder does not exist.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"a film's file must end in .gif or .mp4, got {str(path)!r}")
    if not 0 < fps < np.inf:
        raise ValueError(f"fps must be a finite number > 0, got {fps}")
    if suffix == ".mp4":
        _import_ffmpeg()
    if not Path(path).absolute().parent.is_dir():
        raise FileNotFoundError(f"the folder of {path} does not exist")


def write_video(
    frames: Iterable[ImageArray], path: str | Path, fps: float = 30.0
) -> None:
    """Write frames to a video file; an error leaves no partial file.

    What a killed process has left in the folder is removed.

    Parameters
    ----------
    frames : iterable of ndarray of uint8, shape (H, W, 3)
        All of one size; read one by one.
    path : str or Path
        Ends in .gif (Pillow; the resolution in time is 10 ms) or .mp4 (H.264, needs
        the extra ``slamgym[video]``; odd sizes are padded by one row or column).
    fps : float, default 30
        Frames per second [1/s].

    Raises
    ------
    ValueError
        For another suffix, an fps that is not positive, no frames at all, or frames of
        wrong or unequal shape.
    ImportError
        For .mp4 without imageio-ffmpeg.
    """
    target = Path(path)
    check_video(target, fps)
    write = _write_mp4 if target.suffix.lower() == ".mp4" else _write_gif
    remove_unfinished(target.parent)
    with replace_when_written(target) as partial:
        write(_checked(frames), partial, fps)


def _checked(frames: Iterable[ImageArray]) -> Iterator[ImageArray]:
    """Yield the frames, checking each against the shape of the first."""
    shape = None
    for k, frame in enumerate(frames):
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise ValueError(
                f"frame {k} must be uint8 of shape (H, W, 3), "
                f"got {frame.dtype} of shape {frame.shape}"
            )
        if shape is None:
            shape = frame.shape
        if frame.shape != shape:
            raise ValueError(f"frame {k} must have shape {shape}, got {frame.shape}")
        yield frame
    if shape is None:
        raise ValueError("frames must hold at least one frame, got none")


def _write_gif(frames: Iterator[ImageArray], path: Path, fps: float) -> None:
    first = next(frames)
    palette = _palette(first)
    # No dithering keeps flat colours flat; one palette lets Pillow store only changes.
    images = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in chain([first], frames)
    )
    next(images).save(
        path, save_all=True, append_images=images, duration=1000 / fps, loop=0
    )


def _palette(frame: ImageArray) -> Image.Image:
    """Return 128 colours of one frame and a cube of 125 colours for later frames."""
    own = Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE).getpalette()
    colours = np.reshape(own or [], (-1, 3))
    colours[(colours >= 248).all(axis=1)] = 255  # else Pillow replaces white by grey
    levels = np.linspace(0, 255, 5).round().astype(int)
    cube = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([colours[:128], cube]).ravel().tolist())
    return palette


def _write_mp4(frames: Iterator[ImageArray], path: Path, fps: float) -> None:
    first = next(frames)
    height, width = (size + size % 2 for size in first.shape[:2])
    writer = _import_ffmpeg().write_frames(
        str(path), (width, height), fps=fps, macro_block_size=2
    )
    writer.send(None)
    try:
        for frame in chain([first], frames):
            rows, columns = height - frame.shape[0], width - frame.shape[1]
            padded = np.pad(frame, ((0, rows), (0, columns), (0, 0)), mode="edge")
            writer.send(np.ascontiguousarray(padded))
    finally:
        writer.close()


def _import_ffmpeg() -> ModuleType:
    try:
        return import_module("imageio_ffmpeg")
    except ImportError as error:
        raise ImportError(
            "writing .mp4 needs imageio-ffmpeg (pip install 'slamgym[video]'); "
            "a path ending in .gif needs nothing more"
        ) from error
