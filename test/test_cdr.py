# SPDX-License-Identifier: Apache-2.0
"""Serialised bytes are read and written as rclpy does it; damaged bytes raise MessageError."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from conftest import RosMake, header_of
from hypothesis import given, settings
from hypothesis import strategies as st

import msg_adapters
from msg_adapters import MessageError, outputs
from msg_adapters.cdr import CloudReader, CloudWriter, PoseArrayWriter

MAKE = RosMake()
CLOUD = "sensor_msgs/msg/PointCloud2"
#: Every length modulo 8, and characters of more than one byte.
FRAMES = ["", "a", "ab", "abc", "abcd", "abcde", "abcdef", "abcdefg", "kamera_für_tür"]
COLUMNS = ("x", "y", "confidence", "person_id")


def serialised(msg) -> bytes:
    from rclpy.serialization import serialize_message

    return serialize_message(msg)


def deserialised(data: bytes, type_name: str):
    from rclpy.serialization import deserialize_message

    return deserialize_message(data, type(MAKE(type_name)))


def keypoints(persons: int = 2, frame: str = "camera", seconds: int = 7):
    xy = np.random.default_rng(persons).normal(300, 90, (persons, 17, 2))
    xy[:, 3] = np.nan
    ids = [str(person) for person in range(persons)]
    return outputs.keypoints_cloud(MAKE, header_of(MAKE, seconds, frame=frame), xy, np.ones(xy.shape[:2]), ids)


def same_cloud(found, msg) -> None:
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (msg.header.stamp.sec, msg.header.stamp.nanosec)
    assert found.header.frame_id == msg.header.frame_id
    for name in ("height", "width", "is_bigendian", "point_step", "row_step", "is_dense"):
        assert getattr(found, name) == getattr(msg, name)
    assert [(f.name, f.offset, f.datatype, f.count) for f in found.fields] == [
        (f.name, f.offset, f.datatype, f.count) for f in msg.fields
    ]
    assert bytes(found.data) == bytes(msg.data)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_cloud_is_read_as_rclpy_reads_it(frame):
    read = CloudReader()
    for persons in (2, 2, 0, 1):
        for seconds in (-5, 8):
            msg = keypoints(persons, frame, seconds)
            same_cloud(read(serialised(msg)), msg)


def test_the_adapter_reads_the_same():
    msg = keypoints(3)
    plain = msg_adapters.read(CLOUD, msg, 17)
    packed = msg_adapters.read(CLOUD, CloudReader()(serialised(msg)), 17)
    np.testing.assert_array_equal(packed.xy, plain.xy)
    np.testing.assert_array_equal(packed.visible, plain.visible)
    assert (packed.ids, packed.stamp, packed.frame_id) == (plain.ids, plain.stamp, plain.frame_id)


def test_big_endian_bytes(bag_make):
    store = bag_make.store
    little, big = (
        bytes(store.serialize_cdr(bag_cloud(bag_make, seconds), CLOUD, little_endian=order))
        for seconds, order in ((5, True), (6, False))
    )
    read = CloudReader()
    for data in (little, big, little):
        same_cloud(read(data), store.deserialize_cdr(data, CLOUD))


def bag_cloud(make, seconds):
    return outputs.keypoints_cloud(make, header_of(make, seconds), np.ones((1, 17, 2)), np.ones((1, 17)), ["4"])


def test_a_field_may_change_while_the_length_stays():
    read, msg = CloudReader(), keypoints()
    read(serialised(msg))
    msg.fields[0].name, msg.fields[1].name = "y", "x"
    assert [field.name for field in read(serialised(msg)).fields[:2]] == ["y", "x"]


def test_a_cloud_that_rclpy_padded():
    """DDS pads a payload to a multiple of four bytes."""
    msg = keypoints()
    same_cloud(CloudReader()(serialised(msg) + b"\xaa\xaa\xaa"), msg)


@pytest.mark.parametrize("points", [np.empty((0, 17, 3)), np.random.default_rng(1).normal(size=(3, 17, 3))])
@pytest.mark.parametrize("frame", FRAMES)
def test_poses_are_what_rclpy_would_have_sent(frame, points):
    write = PoseArrayWriter()
    for seconds in (3, -4):
        header = header_of(MAKE, seconds, frame=frame)
        found = deserialised(write(header, points + seconds), "geometry_msgs/msg/PoseArray")
        assert found == outputs.pose_array(MAKE, header, points + seconds)


def test_poses_of_another_number_and_frame():
    write = PoseArrayWriter()
    for persons, frame in ((2, "a"), (5, "a"), (5, "bc"), (1, "bc"), (0, "bc"), (2, "a")):
        points, header = np.full((persons, 3), persons + 0.5), header_of(MAKE, persons, frame=frame)
        found = deserialised(write(header, points), "geometry_msgs/msg/PoseArray")
        assert found == outputs.pose_array(MAKE, header, points)


def test_bytes_already_given_do_not_change():
    write = PoseArrayWriter()
    first = write(header_of(MAKE), np.ones((2, 3)))
    kept = bytes(first)
    write(header_of(MAKE, 99), np.zeros((2, 3)))
    assert first == kept


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("persons", [0, 1, 3])
def test_a_cloud_is_what_rclpy_would_have_sent(frame, persons):
    write, rng = CloudWriter(COLUMNS), np.random.default_rng(persons)
    for seconds in (3, -4):
        header, xy = header_of(MAKE, seconds, frame=frame), rng.normal(size=(persons, 17, 2))
        xy[1:] = np.nan
        plain = outputs.keypoints_cloud(MAKE, header, xy, rng.random((persons, 17)), np.arange(persons))
        values = np.frombuffer(plain.data, "<f4").reshape(persons, 17, 4)
        assert deserialised(write(header, values), CLOUD) == plain


def test_stamps_out_of_range_are_refused():
    for write, values in ((PoseArrayWriter(), np.zeros((1, 3))), (CloudWriter(COLUMNS), np.zeros((1, 17, 4)))):
        header = header_of(MAKE)
        write(header, values)
        with pytest.raises(struct.error):
            write(type("Header", (), {"frame_id": "", "stamp": type("Time", (), {"sec": 2**40, "nanosec": 0})}), values)


# --- damage


def only_message_errors(read: CloudReader, data: bytes) -> None:
    """Read bytes and the cloud; only a MessageError may come."""
    try:
        msg_adapters.read(CLOUD, read(data), 17)
    except MessageError as error:
        assert str(error)


@pytest.mark.parametrize("length", [0, 1, 3, 4, 11, 12, 30, 60, 100, 200, -1])
def test_half_a_message_is_damage(length):
    data = serialised(keypoints())
    with pytest.raises(MessageError) as error:
        CloudReader()(data[:length] if length >= 0 else data[: -4 * 17 * 4])
    assert error.value.reason == "damaged_bytes" and "PointCloud2" in str(error.value)


def test_half_a_message_after_a_whole_one_is_damage():
    data, read = serialised(keypoints()), CloudReader()
    read(data)
    for length in range(0, len(data) - 8, 7):
        with pytest.raises(MessageError):
            read(data[:length])
    same_cloud(read(data), keypoints())


@pytest.mark.parametrize("encoding", [2, 3, 6, 7, 10, 255])
def test_other_encodings_are_refused(encoding):
    data = bytearray(serialised(keypoints()))
    data[1] = encoding
    with pytest.raises(MessageError):
        CloudReader()(bytes(data))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes(data):
    only_message_errors(CloudReader(), data)
    only_message_errors(CloudReader(), b"\0\1\0\0" + data)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 250), st.integers(0, 255)), max_size=6), st.integers(0, 400))
def test_damaged_bytes(changes, cut):
    data = bytearray(serialised(keypoints()))
    for place, value in changes:
        data[place] = value
    read = CloudReader()
    only_message_errors(read, bytes(data[: len(data) - cut]))
    only_message_errors(read, bytes(data))
    same_cloud(read(serialised(keypoints())), keypoints())
