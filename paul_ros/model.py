# SPDX-License-Identifier: Apache-2.0
"""The model file: load, check, save; and the forward pass from 2D points to a canonical 3D shape, in plain numpy.

A model file is an ``.npz`` archive of float32 weights, the mean shape and one JSON header.  Its last 64 bytes (the zip
comment) are the SHA-256 of all bytes before them, so that any change to the file is noticed.  Nothing is unpickled.
"""

from __future__ import annotations

import difflib
import functools
import hashlib
import io
import json
import math
import operator
import os
import re
import zipfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from paul_ros.errors import LayoutError, ModelError
from paul_ros.files import write_atomically
from paul_ros.layout import Layout, Part

FORMAT_VERSION = 1
DEFAULT_MODEL = "human"
RESIDUAL, CONVOLUTIONAL = "residual", "convolutional"
"""The kinds of 2D encoders."""
_DIGEST_CHARS = 64
_MAX_BYTES = 256 * 2**20
_MAX_LAYERS = 100
_MAX_WIDTH = 2**14


@dataclass(frozen=True)
class Model:
    """A trained shape model: 2D encoder h and shape decoder f_d of the paper's sections 3 and 4.

    Attributes:
        name: file name without suffix.
        header: what the file says of itself (layout, architecture, chirality, units, training provenance).
        layout: the keypoints it was trained on.
        weights: float32 arrays by name.
        mean_shape: (3,P) canonical frame, model units.
        sha256: digest of the file, hex.
    """

    name: str
    header: dict
    layout: Layout
    weights: dict[str, np.ndarray]
    mean_shape: np.ndarray
    sha256: str

    @property
    def metres_per_unit(self) -> float | None:
        """Metres per model unit, None where unknown: such output has no metric scale."""
        return self.header["metres_per_unit"]

    @property
    def stature(self) -> float | None:
        """Metres, standing height of the people whose size ``metres_per_unit`` is; None where that is not told."""
        return self.header.get("stature")

    @property
    def misfit(self) -> float | None:
        """Model units, standard deviation of x and of y of points about where the model puts them; None if unknown."""
        return self.header.get("misfit")

    @property
    def scale(self) -> str:
        """``free``: every frame is normalised by its own size; ``unit``: orthographic data of one fixed scale."""
        return self.header.get("scale", "free")

    @property
    def min_visible(self) -> int:
        """Fewer visible points than this are not lifted: the shape would be mostly guessed."""
        return min(min_visible(self.layout, part) for part in self.layout.parts)

    def normalise(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Image points (N,2,P) as the encoder takes them: centred, in units of the frame's size or of the data's."""
        if self.scale == "unit":
            return centre(W, visible) / self.header["image_unit"]
        return normalise(W, visible)

    def encode(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """h(W, M): codes (N,K) of image points (N,2,P), anywhere in the image; hidden ones are ignored.

        They may be in any unit where ``scale`` is ``free``, else in that of the training data.
        """
        forward = (
            self._convolutional if self.header["architecture"]["encoder"]["kind"] == CONVOLUTIONAL else self._residual
        )
        W = self.normalise(W, visible).astype(np.float32)
        if is_upright(self.header):
            W = upright(W, self.weights["encoder.axes"])
        return forward(W, visible)

    def _residual(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """The twin of ``training.networks.ResidualEncoder``."""
        x = _relu(self._linear("encoder.input", np.concatenate([W.reshape(len(W), -1), visible], axis=1)))
        for block in range(self.header["architecture"]["encoder"]["blocks"]):
            inner = _relu(self._linear(f"encoder.blocks.{block}.first", x))
            x = x + _relu(self._linear(f"encoder.blocks.{block}.second", inner))
        return self._linear("encoder.output", x)

    def _convolutional(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """The twin of ``training.networks.ConvolutionalEncoder``."""
        dictionaries = 1 + self.header["architecture"]["encoder"]["blocks"]
        x = (W @ self.weights["encoder.dictionaries.0"].T).reshape(len(W), 6, -1)
        for layer in range(dictionaries):
            x = x if layer == 0 else x @ self.weights[f"encoder.dictionaries.{layer}"].T
            x = _relu(x - self.weights[f"encoder.thresholds.{layer}"])
        return self._linear("encoder.output", np.concatenate([x.reshape(len(x), -1), visible], axis=1))

    def decode(self, code: np.ndarray) -> np.ndarray:
        """f_d(phi): canonical shapes (N,3,P) in model units of codes (N,K)."""
        x = np.asarray(code, np.float32)
        layers = len(self.header["architecture"]["decoder"]["hidden"])
        for layer in range(layers):
            x = _elu(self._linear(f"decoder.{layer}", x))
        S = self._linear(f"decoder.{layers}", x).reshape(len(x), 3, -1)
        return to_unit_size(S, self.layout) if self.scale == "free" else to_centre(S, self.layout)

    def shape(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """f_d(h(W, M)): canonical shapes (N,3,P) in model units of image points (N,2,P)."""
        return self.decode(self.encode(W, visible))

    def rigid(self) -> RigidModel:
        """The baseline that always answers with the mean shape."""
        return RigidModel(**vars(self))

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        y = x @ self.weights[f"{name}.weight"].T
        y += self.weights[f"{name}.bias"]
        return y


class RigidModel(Model):
    """A model whose every shape is the mean shape: what a rigid object would be lifted to."""

    def shape(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.mean_shape, (len(W), *self.mean_shape.shape))


def min_visible(layout: Layout, part: Part) -> int:
    """Fewest visible points of a part of the layout that are lifted: what the layout says, else 30 %, at least 4."""
    points = len(part.points)
    return min(points, layout.min_visible or max(4, math.ceil(0.3 * points)))


def enough_visible(visible: np.ndarray, layout: Layout) -> np.ndarray:
    """Whether frames with visibility (N,P) show enough points to be lifted, (N,): of one category, where it has some.

    Arrays and tensors alike.
    """
    enough = [visible[:, part.columns].sum(1) >= min_visible(layout, part) for part in layout.parts]
    return functools.reduce(operator.or_, enough)


def centre(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Image points (N,2,P) about the mean of the visible ones; hidden ones 0."""
    return _centre(W, visible)[0]


def _centre(W: np.ndarray, visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same, and how many points are visible, at least 1: (N,1,1)."""
    seen = visible[:, None]
    count = np.maximum(seen.sum(2, keepdims=True), 1)
    W = np.where(seen, W, 0.0)
    W -= W.sum(2, keepdims=True) / count
    return np.where(seen, W, 0.0), count


def normalise(W: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Image points (N,2,P) about the mean of the visible ones, in units of their rms distance to it; hidden ones 0."""
    W, count = _centre(W, visible)
    size = np.sqrt((W * W).sum((1, 2), keepdims=True) / count)
    return W / np.where(size > 0, size, 1.0)


def is_upright(header: dict) -> bool:
    """Whether h sees views brought upright; older models say nothing of it, and theirs does not."""
    return header["architecture"]["encoder"].get("upright", False)


def upright(W: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Image points (N,2,P) turned and mirrored to one side, which to an orthographic camera changes no shape.

    An image turned is one of a camera that rolled, an image mirrored one from behind: h need not learn either. The sum
    of the points weighted by the first of ``axes`` (2,P) comes to point along y, by the second to have a positive x.
    """
    direction = W @ axes[0]
    x, y = (direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)).T
    turned = np.stack([np.stack([y, -x], 1), np.stack([x, y], 1)], 1) @ W
    turned[turned[:, 0] @ axes[1] < 0, 0] *= -1
    return turned


def to_centre(S: np.ndarray, layout: Layout) -> np.ndarray:
    """Shapes (N,3,P) about the mean of their points; each category's about its own."""
    centred = np.empty_like(S)
    for part in layout.parts:
        centred[:, :, part.columns] = _about_mean(S[:, :, part.columns])
    return centred


def _about_mean(points: np.ndarray) -> np.ndarray:
    return points - points.sum(2, keepdims=True) / points.shape[2]


def to_unit_size(S: np.ndarray, layout: Layout) -> np.ndarray:
    """Shapes (N,3,P) about the mean of their points, in model units.

    The size of a shape seen by weak perspective is free.  Where the layout has edges the mean edge length is 1, because
    bones keep their lengths when a body moves; else the root mean square distance to the centre is 1.  Of several
    categories each is measured by itself.
    """
    sized = np.empty_like(S)
    for part in layout.parts:
        points = _about_mean(S[:, :, part.columns])
        if part.edges:
            ends = S.take(part.ends, axis=2)
            bones = ends[:, :, 0] - ends[:, :, 1]
            size = np.sqrt((bones * bones).sum(1)).sum(1) / len(part.edges)
        else:
            size = np.sqrt((points * points).sum((1, 2)) / len(part.points))
        sized[:, :, part.columns] = points / np.maximum(size, 1e-6)[:, None, None]
    return sized


def _relu(x: np.ndarray) -> np.ndarray:
    """In place."""
    return np.maximum(x, 0, out=x)


def _elu(x: np.ndarray) -> np.ndarray:
    # expm1(x) is never less than x.
    return np.maximum(x, np.expm1(np.minimum(x, 0)))


def model_names() -> list[str]:
    """Names of the shipped models."""
    folder = resources.files("paul_ros") / "models"
    return sorted(item.name[:-4] for item in folder.iterdir() if item.name.endswith(".npz"))


def load_model(name_or_path: str | os.PathLike = DEFAULT_MODEL) -> Model:
    """Load and check a shipped model by name, or any model file by path.

    Raises:
        ModelError: no such model; damaged; of another format version; not a model file.
    """
    try:
        path = _find(name_or_path)
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"model '{name_or_path}' cannot be read: {error.strerror}") from error
    name = Path(path.name).stem
    where = f"model file '{name_or_path}'"
    if not data.startswith(b"PK") or not re.fullmatch(rb"[0-9a-f]{%d}" % _DIGEST_CHARS, data[-_DIGEST_CHARS:]):
        raise ModelError(f"{where} is no model file, or is cut off (expected the .npz that `paul train` writes)")
    digest = hashlib.sha256(data[:-_DIGEST_CHARS]).hexdigest()
    if data[-_DIGEST_CHARS:] != digest.encode():
        raise ModelError(f"{where} is damaged (its checksum does not match): copy it again or export it anew")
    try:
        arrays = _read_arrays(data)
        header = json.loads(bytes(arrays.pop("header")).decode())
    except Exception as error:  # zipfile, zlib, numpy and json report what they cannot read in a dozen ways
        raise ModelError(f"{where} is no model file: {error}") from error
    if not isinstance(header, dict):
        raise ModelError(f"{where} is no model file: its header is a {type(header).__name__}, not an object")
    if header.get("format") is True or header.get("format") != FORMAT_VERSION:
        raise ModelError(
            f"{where} has format version {header.get('format')}, this paul_ros reads {FORMAT_VERSION}: "
            f"export it anew with `paul train`, or install the paul_ros that wrote it"
        )
    try:
        layout = Layout.from_dict(header["layout"])
        _check(header, layout, arrays)
    except (KeyError, TypeError, ValueError, LayoutError) as error:
        raise ModelError(f"{where} does not fit its own header: {error}") from error
    return Model(name, header, layout, arrays, arrays.pop("mean_shape"), digest)


def _find(name_or_path: str | os.PathLike):
    text = os.fspath(name_or_path)
    if text in model_names():
        return resources.files("paul_ros") / "models" / f"{text}.npz"
    path = Path(text)
    if not path.is_file():
        near = difflib.get_close_matches(text, model_names(), n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"shipped models: {', '.join(model_names())}"
        raise ModelError(f"no model '{text}': neither a file nor a shipped model; {hint}")
    if path.stat().st_size > _MAX_BYTES:
        raise ModelError(f"model file '{text}' is larger than {_MAX_BYTES >> 20} MiB: not a paul_ros model")
    return path


def _read_arrays(data: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(item.file_size for item in archive.infolist()) > 4 * _MAX_BYTES:
            raise ValueError("it unpacks to more than a model can hold")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        # In columns, which a few persons' x @ weight.T reads twice as fast as rows.
        return {name: np.asfortranarray(archive[name]) for name in archive.files}


def weight_shapes(header: dict, points: int) -> dict[str, tuple[int, ...]]:
    """Shapes of all arrays that a model with this header and P points must hold."""
    encoder, K = header["architecture"]["encoder"], header["bottleneck"]
    shapes: dict[str, tuple[int, ...]] = {"mean_shape": (3, points)}
    if is_upright(header):
        shapes["encoder.axes"] = (2, points)
    layers = {}
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
    for name, size in layers.items():
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = size, size[:1]
    return shapes


def dictionary_sizes(width: int, blocks: int, bottleneck: int) -> list[int]:
    """Atoms of a convolutional encoder's dictionaries: from the width down to the bottleneck in equal steps."""
    return [round(width + (bottleneck - width) * layer / blocks) for layer in range(blocks + 1)]


def _check(header: dict, layout: Layout, arrays: dict[str, np.ndarray]) -> None:
    """Raise ValueError, TypeError or KeyError where the header is not one or the arrays are not those it speaks of."""
    _check_length("metres_per_unit", header["metres_per_unit"])
    _check_length("stature", header.get("stature"))
    _check_length("misfit", header.get("misfit"))
    _check_scale(header)
    _check_architecture(header)
    expected = weight_shapes(header, len(layout.names))
    if odd := sorted(set(expected) ^ set(arrays)):
        raise ValueError(f"arrays missing or unknown: {', '.join(odd[:5])}{' ...' if len(odd) > 5 else ''}")
    for name, shape in expected.items():
        # Larger weights than any training gives would overflow in the forward pass.
        if arrays[name].dtype != np.float32 or arrays[name].shape != shape or not (np.abs(arrays[name]) < 1e6).all():
            raise ValueError(f"array {name} is not float32 of shape {shape} and moderate size")


def _check_length(name: str, length: object) -> None:
    if length is not None and not (type(length) in (int, float) and 1e-6 < length < 1e6):
        raise ValueError(f"{name} is {length!r}")


def _check_scale(header: dict) -> None:
    scale, unit = header.get("scale", "free"), header.get("image_unit")
    if scale not in ("free", "unit"):
        raise ValueError(f"unknown scale {scale!r}")
    if scale == "unit" and not (type(unit) in (int, float) and 1e-12 < unit < 1e12):
        raise ValueError(f"image_unit is {unit!r}, a model of scale 'unit' needs it")


def _check_architecture(header: dict) -> None:
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


def check_size(header: dict, points: int) -> None:
    """Refuse an architecture whose model file could not be loaded; raises ModelError, before any training."""
    try:
        _check_architecture(header)
        bytes_ = 4 * sum(math.prod(shape) for shape in weight_shapes(header, points).values())
        if bytes_ > 0.9 * _MAX_BYTES:
            raise ValueError(f"{bytes_ / 2**20:.0f} MiB of weights, a model file holds at most {_MAX_BYTES >> 20}")
    except ValueError as error:
        raise ModelError(f"a model of this recipe could not be loaded: {error}") from None


def save_model(path: str | os.PathLike, header: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write a model file atomically.

    Args:
        path: where to; an existing file is replaced only once the new one is complete.
        header: see the class; ``format`` is filled in.
        arrays: float32, named and shaped as ``weight_shapes`` says, and ``mean_shape`` (3,P).

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
    np.savez(buffer, header=np.frombuffer(text, np.uint8), **arrays)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = b"0" * _DIGEST_CHARS
    body = buffer.getvalue()[:-_DIGEST_CHARS]
    write_atomically(path, body + hashlib.sha256(body).hexdigest().encode())
