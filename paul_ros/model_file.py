# SPDX-License-Identifier: Apache-2.0
"""The model file: load, check, save.

A model file is an ``.npz`` archive of float32 weights, the mean shape and one JSON header. Its last 64 bytes (the zip
comment) are the SHA-256 of all bytes before them, so that every change to the file is detected. Nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import zipfile
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from paul_ros.errors import ModelError
from paul_ros.files import write_atomically
from paul_ros.layout import Layout
from paul_ros.model import CONVOLUTIONAL, RESIDUAL, Model, is_upright
from paul_ros.wording import nearest

FORMAT_VERSION = 1
DEFAULT_MODEL = "human"
_DIGEST_CHARS = 64
_MAX_BYTES = 256 * 2**20
_MAX_LAYERS = 100
_MAX_WIDTH = 2**14

# --- load


def model_names() -> list[str]:
    """Return the names of the shipped models, sorted."""
    folder = resources.files("paul_ros") / "models"
    return sorted(item.name[:-4] for item in folder.iterdir() if item.name.endswith(".npz"))


def load_model(name_or_path: str | os.PathLike[str] = DEFAULT_MODEL) -> Model:
    """Load and check a shipped model by name, or any model file by path.

    Raises:
        ModelError: there is no such model, or the file is unreadable, damaged, of another format version, or not a
            model file.
    """
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise ModelError(f"model is a {type(name_or_path).__name__}: pass a name or the path of a model file")
    name, data = _read(name_or_path)
    where = f"model file '{name_or_path}'"
    digest = _verified_digest(data, where)
    try:
        arrays = _read_arrays(data)
        header = json.loads(bytes(arrays.pop("header")).decode())
    except Exception as error:  # zipfile, zlib, numpy and json report unreadable data in a dozen ways
        raise ModelError(f"{where} is not a model file: {error}") from error
    if not isinstance(header, dict):
        raise ModelError(f"{where} is not a model file: its header is a {type(header).__name__}, not an object")
    if header.get("format") is True or header.get("format") != FORMAT_VERSION:
        raise ModelError(
            f"{where} has format version {header.get('format')}, this paul_ros reads {FORMAT_VERSION}: "
            f"export it anew with `paul train`, or install the paul_ros that wrote it"
        )
    try:
        layout = Layout.from_dict(header["layout"])
        _check(header, layout, arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{where} does not fit its own header: {error}") from error
    return Model(name, header, layout, arrays, arrays.pop("mean_shape"), digest)


def _verified_digest(data: bytes, where: str) -> str:
    """Return the checksum in a model file, hexadecimal; raise ModelError if the data do not have it."""
    if not data.startswith(b"PK") or not re.fullmatch(rb"[0-9a-f]{%d}" % _DIGEST_CHARS, data[-_DIGEST_CHARS:]):
        raise ModelError(f"{where} is not a model file, or is truncated (expected the .npz that `paul train` writes)")
    digest = hashlib.sha256(data[:-_DIGEST_CHARS]).hexdigest()
    if data[-_DIGEST_CHARS:] != digest.encode():
        raise ModelError(f"{where} is damaged (its checksum does not match): copy it again or export it anew")
    return digest


def _read(name_or_path: str | os.PathLike[str]) -> tuple[str, bytes]:
    """Return a model's name, without suffix, and its file's bytes."""
    try:
        text = os.fspath(name_or_path)
        if text in model_names():
            return text, (resources.files("paul_ros") / "models" / f"{text}.npz").read_bytes()
        path = _user_file(text)
        return path.stem, path.read_bytes()
    except OSError as error:
        raise ModelError(f"model '{name_or_path}' cannot be read: {error.strerror}") from error


def _user_file(text: str) -> Path:
    path = Path(text)
    if not path.is_file():
        near = nearest(text, model_names())
        hint = f"did you mean '{near}'?" if near else f"shipped models: {', '.join(model_names())}"
        raise ModelError(f"no model '{text}': neither a file nor a shipped model; {hint}")
    if path.stat().st_size > _MAX_BYTES:
        raise ModelError(f"model file '{text}' is larger than {_MAX_BYTES >> 20} MiB: not a paul_ros model")
    return path


def _read_arrays(data: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(item.file_size for item in archive.infolist()) > 4 * _MAX_BYTES:
            raise ValueError("it unpacks to more than a model can hold")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        # In columns: x @ weight.T of a few persons reads them twice as fast as rows.
        return {name: np.asfortranarray(archive[name]) for name in archive.files}


# --- check


def weight_shapes(header: dict[str, Any], points: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes, by name, of all arrays of a model with this header and P points."""
    encoder, K = header["architecture"]["encoder"], header["bottleneck"]
    shapes: dict[str, tuple[int, ...]] = {"mean_shape": (3, points)}
    if is_upright(header):
        shapes["encoder.axes"] = (2, points)
    layers: dict[str, tuple[int, int]] = {}
    if encoder["kind"] == CONVOLUTIONAL:
        atoms = dictionary_sizes(encoder["width"], encoder["blocks"], K)
        for layer, (size, before) in enumerate(zip(atoms, [points, *atoms])):
            shapes[f"encoder.dictionaries.{layer}"] = (size if layer else 3 * size, before)
            shapes[f"encoder.thresholds.{layer}"] = (size,)
        layers["encoder.output"] = (K, 6 * atoms[-1] + points)
    else:
        width = encoder["width"]
        layers |= {"encoder.input": (width, 3 * points), "encoder.output": (K, width)}
        for block in range(encoder["blocks"]):
            layers[f"encoder.blocks.{block}.first"] = layers[f"encoder.blocks.{block}.second"] = (width, width)
    sizes = [K, *header["architecture"]["decoder"]["hidden"], 3 * points]
    for layer, (inputs, outputs) in enumerate(zip(sizes, sizes[1:])):
        layers[f"decoder.{layer}"] = (outputs, inputs)
    for name, rows_and_columns in layers.items():
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = rows_and_columns, rows_and_columns[:1]
    return shapes


def dictionary_sizes(width: int, blocks: int, bottleneck: int) -> list[int]:
    """Return the numbers of atoms of a convolutional encoder: from the width to the bottleneck in equal steps."""
    return [round(width + (bottleneck - width) * layer / blocks) for layer in range(blocks + 1)]


def check_size(header: dict[str, Any], points: int) -> None:
    """Refuse an architecture whose model file could not be loaded, before any training.

    Raises:
        ModelError: the architecture is unknown, or its weights are too large.
    """
    try:
        _check_architecture(header)
        bytes_ = 4 * sum(math.prod(shape) for shape in weight_shapes(header, points).values())
        if bytes_ > 0.9 * _MAX_BYTES:
            raise ValueError(f"{bytes_ / 2**20:.0f} MiB of weights, a model file holds at most {_MAX_BYTES >> 20}")
    except ValueError as error:
        raise ModelError(f"a model of this recipe could not be loaded: {error}") from None


def _check(header: dict[str, Any], layout: Layout, arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError, TypeError or KeyError if the header is malformed or the arrays do not fit it."""
    _check_length("metres_per_unit", header["metres_per_unit"])
    _check_length("stature", header.get("stature"))
    _check_length("misfit", header.get("misfit"))
    _check_scale(header)
    _check_architecture(header)
    expected = weight_shapes(header, len(layout.names))
    if odd := sorted(set(expected) ^ set(arrays)):
        raise ValueError(f"arrays missing or unknown: {', '.join(odd[:5])}{' ...' if len(odd) > 5 else ''}")
    for name, shape in expected.items():
        # Weights beyond what training gives would overflow in the forward pass.
        if arrays[name].dtype != np.float32 or arrays[name].shape != shape or not (np.abs(arrays[name]) < 1e6).all():
            raise ValueError(f"array {name} is not float32 of shape {shape} and moderate size")


def _check_length(name: str, length: object) -> None:
    if length is not None and not _is_between(length, 1e-6, 1e6):
        raise ValueError(f"{name} is {length!r}, not a number between 1e-6 and 1e6")


def _is_between(value: object, low: float, high: float) -> bool:
    """Return whether a value is a number, not a bool, between two others."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low < value < high


def _check_scale(header: dict[str, Any]) -> None:
    scale, unit = header.get("scale", "free"), header.get("image_unit")
    if scale not in ("free", "unit"):
        raise ValueError(f"unknown scale {scale!r}")
    if scale == "unit" and not _is_between(unit, 1e-12, 1e12):
        raise ValueError(f"image_unit is {unit!r}, a model of scale 'unit' needs it")


def _check_architecture(header: dict[str, Any]) -> None:
    encoder, decoder = header["architecture"]["encoder"], header["architecture"]["decoder"]
    if encoder["kind"] not in (RESIDUAL, CONVOLUTIONAL) or decoder["kind"] != "mlp":
        raise ValueError(f"unknown architecture {encoder['kind']!r}, {decoder['kind']!r}")
    sizes = [header["bottleneck"], encoder["width"], *decoder["hidden"]]
    if not all(type(size) is int and 0 < size <= _MAX_WIDTH for size in [*sizes, encoder["blocks"]]):
        raise ValueError(f"layer sizes must be whole numbers from 1 to {_MAX_WIDTH}")
    if type(is_upright(header)) is not bool:
        raise ValueError(f"upright is {is_upright(header)!r}, neither true nor false")
    if len(sizes) > _MAX_LAYERS or encoder["blocks"] > _MAX_LAYERS:
        raise ValueError(f"more than {_MAX_LAYERS} layers")


# --- save


def save_model(path: str | os.PathLike[str], header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write a model file atomically.

    Args:
        path: file to write; an existing one is replaced when the new one is complete.
        header: see ``Model``; ``format`` is filled in.
        arrays: names and shapes are those of ``weight_shapes``; saved as float32.

    Raises:
        ModelError: header and arrays do not fit together.
    """
    header = {"format": FORMAT_VERSION, **header}
    arrays = {name: np.asarray(value, np.float32) for name, value in arrays.items()}
    try:
        _check(header, Layout.from_dict(header["layout"]), arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"not saved, the model does not fit its own header: {error}") from error
    text = json.dumps(header, indent=1, sort_keys=True).encode()
    buffer = io.BytesIO()
    members: dict[str, Any] = {"header": np.frombuffer(text, np.uint8), **arrays}
    np.savez(buffer, **members)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = b"0" * _DIGEST_CHARS
    body = buffer.getvalue()[:-_DIGEST_CHARS]
    write_atomically(path, body + hashlib.sha256(body).hexdigest().encode())
