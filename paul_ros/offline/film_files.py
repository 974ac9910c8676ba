# SPDX-License-Identifier: Apache-2.0
"""Film files: pictures written as .gif, as .mp4 (by ffmpeg), or below each other as one .png."""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.palette import SIDE_COLOURS
from paul_ros.errors import PictureError
from paul_ros.extras import require
from paul_ros.files import atomic_file, write_atomically
from paul_ros.offline.canvas import AMBER, CALM, INK

PICTURES_PER_SECOND = 10
SUFFIXES = (".gif", ".mp4", ".png")


def check_format(path: Path) -> None:
    """Check that a film with this suffix can be written here.

    Raises:
        PictureError: the suffix is unknown, or ffmpeg is missing.
    """
    if path.suffix not in SUFFIXES:
        raise PictureError(f"{path}: a film is a file that ends in {' or '.join(SUFFIXES)}")
    if path.suffix == ".mp4" and not shutil.which("ffmpeg"):
        raise PictureError(f"{path}: mp4 needs the program ffmpeg, which is missing; choose a name ending in .gif")


def write_film(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Write a film atomically.

    Args:
        path: the suffix chooses the format, one of SUFFIXES.
        pictures: one or more of equal size, (height, width, 3) uint8.

    Raises:
        PictureError: the format cannot be written, or ffmpeg failed.
    """
    check_format(path)
    {".gif": _write_gif, ".mp4": _write_mp4, ".png": _write_png}[path.suffix](path, pictures)


def _write_gif(path: Path, pictures: Iterable[np.ndarray]) -> None:
    require("bags", "PIL")  # Pillow comes with matplotlib
    from PIL import Image

    palette = _gif_palette()
    frames = (Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    buffer = io.BytesIO()
    next(frames).save(buffer, "GIF", save_all=True, append_images=frames, duration=1000 // PICTURES_PER_SECOND, loop=0)
    write_atomically(path, buffer.getvalue())


def _gif_palette() -> Any:
    """Return an image with the drawing's colours in steps down to white: one palette for all pictures, no flicker."""
    from PIL import Image, ImageColor

    colours = [*SIDE_COLOURS.values(), AMBER, CALM, INK, "#000000"]
    steps = np.linspace(0, 1, 24)[:, None]
    blended = [steps * ImageColor.getrgb(colour) + (1 - steps) * 255 for colour in colours]
    mixed = [steps[::3] * ImageColor.getrgb(INK) + (1 - steps[::3]) * ImageColor.getrgb(bar) for bar in (CALM, AMBER)]
    table = np.concatenate([*blended, *mixed]).round().astype(np.uint8)
    image = Image.new("P", (1, 1))
    image.putpalette(np.concatenate([table, np.zeros((256 - len(table), 3), np.uint8)]).tobytes())
    return image


def _write_png(path: Path, pictures: Iterable[np.ndarray]) -> None:
    require("bags", "PIL")
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(list(pictures))).save(buffer, "PNG")
    write_atomically(path, buffer.getvalue())


def _write_mp4(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Pipe the pictures through ffmpeg into a temporary file, which it must be able to seek in, then copy that."""
    pictures = iter(pictures)
    first = next(pictures)
    height, width = first.shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        command = ["ffmpeg", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]
        command += ["-s", f"{width}x{height}", "-r", str(PICTURES_PER_SECOND), "-i", "-", "-pix_fmt", "yuv420p"]
        with subprocess.Popen([*command, str(film)], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
            assert ffmpeg.stdin
            try:
                for picture in chain([first], pictures):
                    ffmpeg.stdin.write(picture.tobytes())
            except BrokenPipeError:
                pass  # ffmpeg explains on stderr why it stopped
            _, complaint = ffmpeg.communicate()
        if ffmpeg.returncode or not film.exists():
            raise PictureError(f"{path}: ffmpeg failed: {' '.join(complaint.decode(errors='replace').split())}")
        with film.open("rb") as made, atomic_file(path) as file:
            shutil.copyfileobj(made, file)
