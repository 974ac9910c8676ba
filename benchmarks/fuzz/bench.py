# SPDX-License-Identifier: Apache-2.0
"""Whole files that the cases break, and what all cases share: the model and the factories of messages."""

from __future__ import annotations

import hashlib
import io
import json
import random
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import foreign_messages as foreign
import numpy as np

from benchmarks.fuzz.messages import BagMake, LiveMake, camera_info, cloud, depth_image, header, pose_array, random_pose
from paul_ros.layout import load_layout
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model, weight_shapes
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.stream.messages import MessageBuilder
from paul_ros.stream.stream import LiftStream

if TYPE_CHECKING:
    from benchmarks.fuzz.requests import Node


class Bench:
    """The model, factories and files that all cases share.

    Attributes:
        folder: of files.
        model: that lifts.
        live: factory of messages like rclpy's.
        bag: factory of messages like those of bags.
        tiny: header and arrays of a small model.
        whole_bags: small bags, one a compression.
        objects: builder of outputs as message objects.
        packed: builder of outputs as bytes; one for all frames, as in a node.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._node: Node | None = None
        self.model = load_model()
        self.live, self.bag = LiveMake(), BagMake(foreign.DEFINITIONS)
        self.tiny = _tiny_model()
        self.whole_bags = [_tiny_bag(folder / f"{name}.mcap", self.bag, name) for name in ("none", "lz4", "zstd")]
        self.objects, self.packed = MessageBuilder(self.bag), MessageBuilder(self.bag, packed=True)

    def node(self) -> Node:
        """Return the running node that all sessions share; the first call starts it."""
        if self._node is None:
            from benchmarks.fuzz.requests import Node

            with warnings.catch_warnings():
                warnings.simplefilter("default")  # the imports of rclpy warn
                self._node = Node(self.folder)
        return self._node

    def close(self) -> None:
        """End the node."""
        if self._node is not None:
            self._node.close()

    def rewritten(self, message: Any, data: bytes) -> bytes:
        """Read and write a serialised message anew, because the value of padding is arbitrary."""
        return self.bag.serialise(self.bag.deserialise(data, message.__msgtype__))

    def stream(self, rng: random.Random) -> LiftStream:
        """Return a stream with random settings."""
        layout = rng.choice((None, None, "coco17", "body25", "h36m17"))
        output = rng.choice((None, None, self.model.layout))
        smoothing = rng.choice((0.0, 0.0, 1.0))
        lifter = Lifter(self.model)
        return LiftStream(lifter, load_layout(layout) if layout else None, 0.3, 64, output, smoothing)


def _tiny_model() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return header and arrays of a small model."""
    layout = load_layout("coco17")
    sizes = {"encoder": {"kind": "residual", "width": 4, "blocks": 1}, "decoder": {"kind": "mlp", "hidden": [4]}}
    plain = {"format": 1, "layout": layout.to_dict(), "bottleneck": 2, "metres_per_unit": 0.3, "stature": 1.7}
    head = {**plain, "misfit": 0.05, "chirality": {"known": True, "source": "made"}, "architecture": sizes}
    numbers = np.random.default_rng(0)
    shapes = weight_shapes(head, len(layout.names))
    return head, {name: numbers.normal(size=size).astype(np.float32) for name, size in shapes.items()}


def model_file(head: Any, arrays: dict[str, Any]) -> bytes:
    """Return the bytes of a model file without its checksum."""
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(json.dumps(head).encode(), np.uint8), **arrays)
    return buffer.getvalue()


def sealed(data: bytes) -> bytes:
    """Append the checksum that makes a zip file a model: the zip comment holds the digest of all bytes before it."""
    data = data[:-2] + (64).to_bytes(2, "little") if data[-22:-18] == b"PK\5\6" else data
    return data + hashlib.sha256(data).hexdigest().encode()


def _tiny_bag(path: Path, make: BagMake, compression: str) -> Path:
    """Write a bag of a few messages of each topic."""
    rng = random.Random(1)
    with BagWriter(path, make, compression) as writer:
        writer.write("/camera_info", camera_info(make, rng), 0)
        for number in range(1, 6):
            head = header(make, rng, number)
            writer.write("/keypoints", cloud(make, head, [random_pose(rng)], rng), number)
            writer.write("/depth", depth_image(make, rng, number), number)
            writer.write("/ground_truth/poses", pose_array(make, head, [random_pose(rng)], rng), number)
    return path
