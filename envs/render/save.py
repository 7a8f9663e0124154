"""Frames -> a picture or a film: the ending of the file's name says which."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path
from types import ModuleType

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image

from envs.files import PARTIAL_PREFIX, whole
from envs.render.style import AGENT_COLORS, LIGHT_STYLE, SDC_COLOR
from envs.scene import STEP_SECONDS

Frame = NDArray[np.uint8]


def save_picture(path: str | Path, frames: Iterable[Frame], *, frame_seconds: float = STEP_SECONDS) -> None:
    """Write one frame as PNG, or many as a GIF that loops or an MP4; the file appears whole or not at all.

    Args:
        path: ends in ``.png``, ``.gif`` or ``.mp4``.
        frames: ``[H, W, 3]`` uint8 each; exactly one for a PNG.
        frame_seconds: how long a film shows a frame [s].

    Raises:
        ValueError: another ending, no frame, or a PNG of several frames.
        ImportError: an MP4 without the extra ``video``.

    Examples:
        >>> save_picture("scene.bmp", [])
        Traceback (most recent call last):
        ...
        ValueError: a picture must end in .png, .gif, .mp4, got scene.bmp.
    """
    path = Path(path)
    write = WRITERS.get(path.suffix.lower())
    if write is None:
        raise ValueError(f"a picture must end in {', '.join(WRITERS)}, got {path}.")
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{path}: no frame to write.")
    with whole(path) as part:
        write(part, chain([first], frames), frame_seconds)


def _write_png(part: Path, frames: Iterable[Frame], _: float) -> None:
    first, *others = frames
    if others:
        name = part.name.removeprefix(PARTIAL_PREFIX)
        raise ValueError(f"{name}: {1 + len(others)} frames; a PNG holds exactly one, a GIF or MP4 one or more.")
    Image.fromarray(first).save(part, format="PNG", optimize=True)


def _write_gif(part: Path, frames: Iterable[Frame], frame_seconds: float) -> None:
    images = [Image.fromarray(frame) for frame in frames]
    # One palette for all frames: a palette of its own for each one makes the still map flicker.
    palette = _palette(images[len(images) // 2])
    still = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    duration = round(frame_seconds * 1000)
    still[0].save(part, format="GIF", save_all=True, append_images=still[1:], duration=duration, loop=0)


def check_writable(path: str | Path) -> None:
    """Refuse a picture that could not be written, before it is made.

    Raises:
        ImportError: an MP4 without the extra ``video``.
    """
    if Path(path).suffix.lower() == ".mp4":
        _ffmpeg()


def _ffmpeg() -> ModuleType:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError(
            "an MP4 needs the extra `video`: pip install 'dpa-omf[video]'; a .gif needs nothing"
        ) from error
    return imageio_ffmpeg


def _write_mp4(part: Path, frames: Iterable[Frame], frame_seconds: float) -> None:
    imageio_ffmpeg, writer = _ffmpeg(), None
    for frame in frames:
        height, width = (side - side % 2 for side in frame.shape[:2])  # the codec takes even sides only
        if writer is None:
            writer = imageio_ffmpeg.write_frames(
                str(part),
                (width, height),
                fps=1 / frame_seconds,
                quality=8,
                macro_block_size=2,
                output_params=["-f", "mp4"],
            )
            writer.send(None)
        writer.send(np.ascontiguousarray(frame[:height, :width]))
    writer.close()


WRITERS: dict[str, Callable[[Path, Iterable[Frame], float], None]] = {
    ".png": _write_png,
    ".gif": _write_gif,
    ".mp4": _write_mp4,
}
"""Ending of a file -> what writes it."""


def _palette(image: Image.Image) -> Image.Image:
    """256 colours: every colour that has a meaning, in steps towards white, and what else the picture is made of.

    Colours chosen by area alone lose a cyclist of a few pixels, who then turns into a vehicle.
    """
    names = [SDC_COLOR, *AGENT_COLORS.values(), *(color for _, color in LIGHT_STYLE.values())]
    hues = np.array([to_rgb(name) for name in dict.fromkeys(names)]) * 255
    shades = hues + (255 - hues) * np.linspace(0, 0.9, 12)[:, None, None]
    meaning = np.round(shades).astype(np.uint8).reshape(-1).tolist()
    rest = image.quantize(256 - len(meaning) // 3, dither=Image.Dither.NONE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette((meaning + rest)[: 256 * 3])
    return palette
