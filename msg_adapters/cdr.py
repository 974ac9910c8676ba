# SPDX-License-Identifier: Apache-2.0
"""Messages as they travel, read and written without message objects: serialised bytes to arrays and back.

Of a PoseArray of 170 points rclpy's objects cost a millisecond and a half, these bytes a fiftieth. A subscription made
with ``raw=True`` gives them, and a publisher takes them.

The encoding is plain CDR (OMG, DDS-XTypes 1.3, section 7.4.1, and DDSI-RTPS 2.5, section 10): four bytes that name the
encoding, then the fields in order, each number aligned to its size, counted from behind those four bytes; a string is
its length with the final zero, then its characters; a sequence is its length, then its elements.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from msg_adapters.keypoints import MessageError

#: Second byte of the encoding -> struct's sign for the byte order. Parameter lists and XCDR2 are not read.
_ORDERS = {0: ">", 1: "<"}
_HEAD = 4
_LITTLE = b"\0\1\0\0"
_POSE = 7  # float64: position x, y, z, orientation x, y, z, w
_FLOAT32 = 7


@dataclass(frozen=True)
class Time:
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


@dataclass(frozen=True)
class Header:
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


@dataclass(frozen=True)
class Field:
    """sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True)
class Cloud:
    """sensor_msgs/PointCloud2 with the field names of the message, so that every adapter reads it; data is a view."""

    header: Header
    height: int
    width: int
    fields: tuple[Field, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview
    is_dense: bool


class CloudReader:
    """Serialised PointCloud2 to Cloud.

    From one message to the next mostly the stamp and the points change: what lies between is taken apart only when it
    is another than the last time.
    """

    def __init__(self) -> None:
        self._between = b""
        self._parsed: tuple = ()

    def __call__(self, data: bytes) -> Cloud:
        """Raises MessageError with the reason damaged_bytes."""
        try:
            return self._read(data)
        except (struct.error, UnicodeDecodeError, KeyError, IndexError) as error:
            raise MessageError(
                "damaged_bytes",
                f"{len(data)} bytes are no serialised sensor_msgs/msg/PointCloud2 ({type(error).__name__}: {error}); "
                "does every machine have the same ROS distribution?",
            ) from error

    def _read(self, data: bytes) -> Cloud:
        order = _ORDERS[data[1]]
        stamp = Time(*struct.unpack_from(order + "iI", data, _HEAD))
        start = _HEAD + 8
        # The order is a part of it: the same bytes mean other numbers in the other.
        if not self._between or not data.startswith(self._between, start) or self._parsed[0] != order:
            cursor = _Cursor(data, order, start)
            parsed = (order, *_between(cursor))
            self._between, self._parsed = data[start : cursor.at], parsed
        _, frame_id, height, width, fields, is_bigendian, point_step, row_step, count = self._parsed
        first = start + len(self._between)
        is_dense = bool(data[first + count])  # also tells that all the points are there
        points = memoryview(data)[first : first + count]
        return Cloud(
            Header(stamp, frame_id), height, width, fields, is_bigendian, point_step, row_step, points, is_dense
        )


def _between(cursor: _Cursor) -> tuple:
    """From frame_id to the length of the points, in the message's order."""
    frame_id = cursor.text()
    height, width, fields = cursor.uint32(), cursor.uint32(), cursor.uint32()
    # One by one: a damaged length ends with the bytes, before anything of that size is made.
    parsed = []
    for _ in range(fields):
        parsed.append(Field(cursor.text(), cursor.uint32(), cursor.uint8(), cursor.uint32()))
    return frame_id, height, width, tuple(parsed), bool(cursor.uint8()), *(cursor.uint32() for _ in range(3))


class _Cursor:
    """Reads one value after the other; raises struct.error or IndexError where the bytes end."""

    def __init__(self, data: bytes, order: str, at: int) -> None:
        self.at = at
        self._data = data
        self._uint32 = struct.Struct(order + "I")

    def uint8(self) -> int:
        value = self._data[self.at]
        self.at += 1
        return value

    def uint32(self) -> int:
        at = _aligned(self.at, 4)
        self.at = at + 4
        return self._uint32.unpack_from(self._data, at)[0]

    def text(self) -> str:
        length = self.uint32()
        start, self.at = self.at, self.at + length
        if self.at > len(self._data):
            raise IndexError("a string reaches beyond the end")
        return self._data[start : self.at].rstrip(b"\0").decode()


def _aligned(at: int, size: int) -> int:
    """The next place for a number of `size` bytes; alignment counts from behind the encoding."""
    return at + (_HEAD - at) % size


class PoseArrayWriter:
    """Points to serialised geometry_msgs/PoseArray, what `outputs.pose_array` gives as an object.

    It keeps the last message: only the stamp and the positions change while frame and number of points stay.
    """

    def __init__(self) -> None:
        self._kept: tuple = ()

    def __call__(self, header, points: np.ndarray) -> bytes:
        """points (N,P,3) or (N,3); identity orientation."""
        positions = points.reshape(-1, 3)
        if self._kept != (header.frame_id, len(positions)):
            self._make(header.frame_id, len(positions))
        _put_stamp(self._buffer, header)
        self._poses[:, :3] = positions
        return bytes(self._buffer)

    def _make(self, frame_id: str, count: int) -> None:
        head = _head(frame_id)
        head += _uint32(head, count)
        # A sequence without elements has no alignment for them either.
        head += bytes(_aligned(len(head), 8) - len(head) if count else 0)
        self._buffer = head + bytes(8 * _POSE * count)
        self._poses = np.frombuffer(self._buffer, "<f8", offset=len(head)).reshape(count, _POSE)
        self._poses[:, -1] = 1.0
        self._kept = frame_id, count


class CloudWriter:
    """Float32 columns to serialised organised PointCloud2, as the clouds of `outputs` are."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._kept: tuple = ()

    def __call__(self, header, values: np.ndarray) -> bytes:
        """values (height, width, columns)."""
        if self._kept != (header.frame_id, values.shape):
            self._make(header.frame_id, values.shape)
        _put_stamp(self._before, header)
        dense = np.isfinite(values).all()
        return b"".join((self._before, values.astype("<f4").tobytes(), b"\1" if dense else b"\0"))

    def _make(self, frame_id: str, shape: tuple[int, int, int]) -> None:
        height, width, columns = shape
        head = _head(frame_id)
        for number in (height, width, columns):
            head += _uint32(head, number)
        for index, name in enumerate(self._names):
            head += _text(head, name)
            head += _uint32(head, 4 * index)
            head += bytes([_FLOAT32])
            head += _uint32(head, 1)
        head += b"\0"  # little-endian points
        for number in (4 * columns, 4 * columns * width, 4 * columns * width * height):
            head += _uint32(head, number)
        self._before, self._kept = head, (frame_id, shape)


def _head(frame_id: str) -> bytearray:
    """The encoding and a header whose stamp is yet to come."""
    head = bytearray(_LITTLE + bytes(8))
    head += _text(head, frame_id)
    return head


def _put_stamp(buffer: bytearray, header) -> None:
    struct.pack_into("<iI", buffer, _HEAD, header.stamp.sec, header.stamp.nanosec)


def _uint32(before: bytearray, value: int) -> bytes:
    """What a number adds to the bytes before it."""
    return bytes(_aligned(len(before), 4) - len(before)) + struct.pack("<I", value)


def _text(before: bytearray, value: str) -> bytes:
    """What a string adds to the bytes before it."""
    data = value.encode() + b"\0"
    return _uint32(before, len(data)) + data
