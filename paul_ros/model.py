# SPDX-License-Identifier: Apache-2.0
"""The shape model: the forward pass from 2D points to a canonical 3D shape, in numpy alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from paul_ros.layout import Layout
from paul_ros.normalisation import centre, min_visible, normalise, to_centre, to_unit_size, upright

RESIDUAL, CONVOLUTIONAL = "residual", "convolutional"
"""The kinds of 2D encoders."""


@dataclass(frozen=True)
class Model:
    """A trained shape model: 2D encoder h and shape decoder f_d of the paper's sections 3 and 4.

    >>> from paul_ros import load_model
    >>> model = load_model("human")
    >>> model.layout.name, model.mean_shape.shape, model.stature
    ('human', (3, 43), 1.7)

    Attributes:
        name: file name without suffix.
        header: the file's JSON header: layout, architecture, chirality, units, training provenance.
        layout: the layout of the P keypoints that the model was trained on.
        weights: float32 arrays by name.
        mean_shape: (3,P) canonical frame, model units.
        sha256: digest of the file, hexadecimal.
    """

    name: str
    header: dict[str, Any]
    layout: Layout
    weights: dict[str, np.ndarray]
    mean_shape: np.ndarray
    sha256: str

    @property
    def metres_per_unit(self) -> float | None:
        """Metres per model unit; None if unknown, and the output then has no metric scale."""
        return self.header["metres_per_unit"]

    @property
    def stature(self) -> float | None:
        """Standing height in metres of the people that ``metres_per_unit`` refers to; None if unknown."""
        return self.header.get("stature")

    @property
    def misfit(self) -> float | None:
        """Standard deviation of x, and of y, of points about the model's, in model units; None if unknown."""
        return self.header.get("misfit")

    @property
    def scale(self) -> str:
        """``free``: every frame is normalised by its own size. ``unit``: orthographic data of one fixed scale."""
        return self.header.get("scale", "free")

    @property
    def min_visible(self) -> int:
        """Fewest visible points that are lifted; with fewer, the shape would be mostly guessed."""
        return min(min_visible(self.layout, part) for part in self.layout.parts)

    def normalise(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Centre image points (N,2,P) and scale them by the frame's size, or by the training data's unit."""
        if self.scale == "unit":
            return centre(W, visible) / self.header["image_unit"]
        return normalise(W, visible)

    def encode(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return codes phi = h(W, M).

        Args:
            W: (N,2,P) image points, anywhere in the image; any value where hidden. The unit is free if ``scale`` is
                ``free``, else it is that of the training data.
            visible: (N,P) bool.

        Returns:
            (N,K) float32 codes.
        """
        kind = self.header["architecture"]["encoder"]["kind"]
        forward = self._convolutional if kind == CONVOLUTIONAL else self._residual
        W = self.normalise(W, visible).astype(np.float32)
        if is_upright(self.header):
            W = upright(W, self.weights["encoder.axes"])
        return forward(W, visible)

    def _residual(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return codes as ``training.networks.ResidualEncoder`` does."""
        x = _relu(self._linear("encoder.input", np.concatenate([W.reshape(len(W), -1), visible], axis=1)))
        for block in range(self.header["architecture"]["encoder"]["blocks"]):
            inner = _relu(self._linear(f"encoder.blocks.{block}.first", x))
            x = x + _relu(self._linear(f"encoder.blocks.{block}.second", inner))
        return self._linear("encoder.output", x)

    def _convolutional(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return codes as ``training.networks.ConvolutionalEncoder`` does."""
        dictionaries = 1 + self.header["architecture"]["encoder"]["blocks"]
        x = (W @ self.weights["encoder.dictionaries.0"].T).reshape(len(W), 6, -1)
        for layer in range(dictionaries):
            x = x if layer == 0 else x @ self.weights[f"encoder.dictionaries.{layer}"].T
            x = _relu(x - self.weights[f"encoder.thresholds.{layer}"])
        return self._linear("encoder.output", np.concatenate([x.reshape(len(x), -1), visible], axis=1))

    def decode(self, code: np.ndarray) -> np.ndarray:
        """Return canonical shapes f_d(phi), (N,3,P) in model units, of codes (N,K)."""
        x = np.asarray(code, np.float32)
        layers = len(self.header["architecture"]["decoder"]["hidden"])
        for layer in range(layers):
            x = _elu(self._linear(f"decoder.{layer}", x))
        S = self._linear(f"decoder.{layers}", x).reshape(len(x), 3, -1)
        return to_unit_size(S, self.layout) if self.scale == "free" else to_centre(S, self.layout)

    def shape(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return canonical shapes f_d(h(W, M)), (N,3,P) in model units, of image points (N,2,P)."""
        return self.decode(self.encode(W, visible))

    def rigid(self) -> RigidModel:
        """Return the baseline that always answers with the mean shape."""
        return RigidModel(**vars(self))

    def _linear(self, name: str, x: np.ndarray) -> np.ndarray:
        y = x @ self.weights[f"{name}.weight"].T
        y += self.weights[f"{name}.bias"]
        return y


class RigidModel(Model):
    """A model that answers every image with its mean shape, as if the object were rigid."""

    def shape(self, W: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Return the mean shape, (N,3,P) in model units."""
        return np.broadcast_to(self.mean_shape, (len(W), *self.mean_shape.shape))


def is_upright(header: dict[str, Any]) -> bool:
    """Return whether h sees views in a standard orientation; headers of older models lack the key, which means no."""
    return header["architecture"]["encoder"].get("upright", False)


def _relu(x: np.ndarray) -> np.ndarray:
    """Apply the rectifier in place."""
    return np.maximum(x, 0, out=x)


def _elu(x: np.ndarray) -> np.ndarray:
    # expm1(x) is never smaller than x, so the maximum keeps positive x.
    return np.maximum(x, np.expm1(np.minimum(x, 0)))
