# SPDX-License-Identifier: Apache-2.0
"""A camera for arrays: a calibration file or four numbers become the intrinsics that a CameraInfo message gives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

from msg_adapters import Intrinsics, MessageError, read_camera_info
from msg_adapters.camera_info import FOCAL_PIXELS
from paul_ros.errors import ParameterError

_MAX_BYTES = 1_000_000
_REGION = ("x_offset", "y_offset", "width", "height")
_CURE = (
    "name a YAML file that camera_calibration wrote, or JSON as "
    '{"K": [[900, 0, 640], [0, 900, 360], [0, 0, 1]], "width": 1280, "height": 720}'
)


def read_camera(path: str | Path, image: str = "auto") -> Intrinsics:
    """Read a camera from a YAML or JSON file.

    The file has the keys of camera_calibration (camera_matrix, projection_matrix, distortion_coefficients,
    distortion_model, image_width, image_height) or those of CameraInfo (k, p, d, distortion_model, width, height,
    binning_x, binning_y, roi; in upper or lower case).

    Args:
        path: of the file.
        image: the image of the keypoints: 'rectified', 'raw' or 'auto'; see `read_camera_info`.

    Raises:
        ParameterError: the file is missing or describes no camera; says what to do.
    """
    data = _read(Path(path))
    flat = {key.lower(): value for key, value in data.items() if isinstance(key, str)}
    k, p = _matrix(path, flat, ("camera_matrix", "k"), 9), _matrix(path, flat, ("projection_matrix", "p"), 12)
    if not k and not p:
        raise ParameterError(f"camera file {path} has neither K (camera_matrix) nor P (projection_matrix): {_CURE}")
    d = _numbers(path, flat, ("distortion_coefficients", "d")) or []
    width, height = (_size(path, flat, keys) for keys in (("image_width", "width"), ("image_height", "height")))
    binning = {name: _size(path, flat, (name,)) for name in ("binning_x", "binning_y")}
    roi: Any = flat.get("roi") or {}
    if not isinstance(roi, dict):
        raise ParameterError(f"camera file {path}: roi has no keys: {_CURE}")
    region = {name: _size(path, roi, (name,)) for name in _REGION}
    model = str(flat.get("distortion_model") or "")
    sizes = {"width": width, "height": height, **binning, "roi": SimpleNamespace(**region)}
    message = _message(k, p, d, distortion_model=model, **sizes)
    try:
        return read_camera_info(message, image)
    except MessageError as error:
        raise ParameterError(f"camera file {path}: {error}") from error


def camera_of(fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    """Return the camera of four numbers in pixels.

    Raises:
        ParameterError: no camera has such a focal length or principal point.
    """
    try:
        return read_camera_info(_message([fx, 0, cx, 0, fy, cy, 0, 0, 1], [], []))
    except MessageError as error:
        shortest, longest = FOCAL_PIXELS
        for name, focal_length in (("fx", fx), ("fy", fy)):
            if not shortest <= focal_length <= longest:
                cure = f"{name} is {focal_length:g}; give a focal length of {shortest:g} to {longest:g} pixels"
                break
        else:
            cure = f"cx is {cx:g} and cy {cy:g}; give a principal point within {longest:g} pixels"
        raise ParameterError(f"--intrinsics: {cure}") from error


def _message(k: Sequence[float], p: Sequence[float], d: Sequence[float], **changes: Any) -> SimpleNamespace:
    """Return a CameraInfo with these matrices; empty ones are not filled."""
    whole = SimpleNamespace(**dict.fromkeys(_REGION, 0))
    unset = {"width": 0, "height": 0, "distortion_model": "", "binning_x": 0, "binning_y": 0, "roi": whole}
    return SimpleNamespace(k=k or [0.0] * 9, p=p or [0.0] * 12, d=d, **{**unset, **changes})


def _read(path: Path) -> dict[Any, Any]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ParameterError(f"camera file {path} has more than {_MAX_BYTES} bytes: {_CURE}")
        data = yaml.safe_load(path.read_bytes())
    except FileNotFoundError:
        raise ParameterError(f"camera file {path}: no such file") from None
    except OSError as error:
        raise ParameterError(f"camera file {path}: {error.strerror or error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date such as 2020-99-99 is a ValueError
        raise ParameterError(f"camera file {path} is neither YAML nor JSON: {_CURE}") from error
    if not isinstance(data, dict):
        raise ParameterError(f"camera file {path} has no keys: {_CURE}")
    return data


def _matrix(path: str | Path, data: dict[str, Any], keys: tuple[str, str], size: int) -> list[float]:
    numbers = _numbers(path, data, keys)
    if numbers and len(numbers) != size:
        raise ParameterError(f"camera file {path}: {keys[0]} has {len(numbers)} numbers, it must have {size}: {_CURE}")
    return numbers


def _numbers(path: str | Path, data: dict[str, Any], keys: tuple[str, str]) -> list[float]:
    """Return the numbers of a matrix in row order, flat or nested; none if the file lacks it."""
    key = next((key for key in keys if data.get(key) is not None), None)
    if key is None:
        return []
    value = data[key]
    rows: Any = value.get("data") if isinstance(value, dict) else value
    try:
        flat = [float(number) for row in rows for number in (row if isinstance(row, list) else [row])]
    except (TypeError, ValueError, OverflowError):
        raise ParameterError(f"camera file {path}: {key} is not a list of numbers: {_CURE}") from None
    if not all(map(math.isfinite, flat)):
        raise ParameterError(f"camera file {path}: {key} has a number that is not finite: {_CURE}")
    return flat


def _size(path: str | Path, data: dict[str, Any], keys: tuple[str, ...]) -> int:
    """Return a number of pixels, such as a side of the image; 0 if the file lacks it."""
    value = next((data[key] for key in keys if data.get(key) is not None), 0)
    if type(value) is not int or value < 0:
        raise ParameterError(f"camera file {path}: {keys[0]} is {value!r}, not a number of pixels: {_CURE}")
    return value
