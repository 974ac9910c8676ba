# SPDX-License-Identifier: Apache-2.0
"""Bags: written messages read back; a damaged bag gives everything before the damage, then one clear error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from paul_ros.errors import BagError, OutputError
from paul_ros.files import is_stream
from paul_ros.offline.bag_reader import read_messages, read_records, topics_of
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter

POSES = "geometry_msgs/msg/PoseArray"
TICK = 33_333_333


def header(make, number):
    stamp = make("builtin_interfaces/msg/Time", sec=number, nanosec=7)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


def poses(make, number, count=40):
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    places = np.random.default_rng(number).normal(size=(count, 3)).tolist()
    return make(
        POSES,
        header=header(make, number),
        poses=[
            make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=x, y=y, z=z), orientation=turn)
            for x, y, z in places
        ],
    )


def write(path, count=100, compression="zstd"):
    make = BagMessages()
    with BagWriter(path, make, compression) as bag:
        for number in range(count):
            bag.write("/poses", poses(make, number), number * TICK)
            bag.write("/words", make("std_msgs/msg/String", data=f"frame {number} äöü"), number * TICK + 1)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Several chunks: 200 messages."""
    return write(tmp_path_factory.mktemp("bag") / "whole.mcap")


def read_until_damage(path):
    """The messages that come out and the error that ends them, or None."""
    found = []
    try:
        for topic, _, message, time in read_messages(path):
            found.append((topic, message, time))
    except BagError as error:
        return found, error
    return found, None


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_round_trip(tmp_path, compression):
    make = BagMessages()
    found = list(read_messages(write(tmp_path / "a.mcap", 30, compression)))
    assert len(found) == 60
    for number, (topic, kind, message, time) in enumerate(found[::2]):
        assert (topic, kind, time) == ("/poses", POSES, number * TICK)
        assert message.header.frame_id == "camera" and message.header.stamp.sec == number
        expected = [(p.position.x, p.position.y, p.position.z) for p in poses(make, number).poses]
        assert [(p.position.x, p.position.y, p.position.z) for p in message.poses] == expected
    assert found[5][2].data == "frame 2 äöü"
    assert topics_of(tmp_path / "a.mcap") == {"/poses": (POSES, 30), "/words": ("std_msgs/msg/String", 30)}


def test_only_the_topics_asked_for(bag):
    assert {topic for topic, *_ in read_messages(bag, ["/words"])} == {"/words"}


def test_equal_input_gives_equal_bytes(tmp_path):
    assert write(tmp_path / "a.mcap").read_bytes() == write(tmp_path / "b.mcap").read_bytes()


def test_rosbags_reads_what_is_written(bag):
    """A reader of other people's making."""
    with AnyReader([bag]) as reader:
        assert reader.message_count == 200
        found = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    assert found[1].data == "frame 0 äöü" and found[198].header.stamp.sec == 99


def test_a_record_is_copied_as_it_is(bag, tmp_path):
    with BagWriter(tmp_path / "copy.mcap") as copy:
        for record in read_records(bag):
            copy.write_record(record)
    assert (tmp_path / "copy.mcap").read_bytes() == bag.read_bytes()


def test_two_types_on_one_topic_keep_their_own(tmp_path):
    make = BagMessages()
    messages = [make("std_msgs/msg/String", data="a"), make("std_msgs/msg/Bool", data=True)]
    with BagWriter(tmp_path / "a.mcap") as writer:
        for time, message in enumerate(messages):
            writer.write("/a", message, time)
    read = [(name, message.data) for _, name, message, _ in read_messages(tmp_path / "a.mcap")]
    assert read == [("std_msgs/msg/String", "a"), ("std_msgs/msg/Bool", True)]


def test_cut_anywhere_gives_what_was_whole(bag, tmp_path):
    """Never other messages, never another kind of error; half a file gives about half of them."""
    whole = bag.read_bytes()
    cut, counts = tmp_path / "cut.mcap", []
    for size in [*np.linspace(9, len(whole) - 1, 60).astype(int), len(whole) - 1, len(whole) - 8]:
        cut.write_bytes(whole[:size])
        found, error = read_until_damage(cut)
        assert error is not None and error.messages_read == len(found)
        assert "mcap recover cut.mcap" in str(error) and "\n" not in str(error)
        assert [time for *_, time in found] == [n // 2 * TICK + n % 2 for n in range(len(found))]
        counts.append(len(found))
    assert counts[-1] == 200 and counts == sorted(counts[:-2]) + counts[-2:]
    assert 50 < counts[30] < 140


def test_any_changed_byte_is_noticed_and_costs_one_chunk(bag, tmp_path):
    """The messages behind the damage are read too."""
    whole, rng = bag.read_bytes(), np.random.default_rng(1)
    bad = tmp_path / "bad.mcap"
    expected = [time for *_, time in read_messages(bag)]
    for place in [0, 8, 9, len(whole) - 1, len(whole) - 12, *rng.integers(0, len(whole), 150).tolist()]:
        changed = bytearray(whole)
        changed[place] ^= 1 << int(rng.integers(8))
        bad.write_bytes(changed)
        found, error = read_until_damage(bad)
        assert error is not None, f"byte {place}"
        times = [time for *_, time in found]
        assert times == sorted(times) and set(times) <= set(expected)
        assert place < 8 or len(times) >= len(expected) - 64, f"byte {place}"


@pytest.fixture
def unchunked(tmp_path):
    """A bag without chunks and checksums, as a fast recorder writes it: 20 messages."""
    make, path = BagMessages(), tmp_path / "unchunked.mcap"
    with open(path, "wb") as file:
        writer = McapWriter(file, use_chunking=False, enable_crcs=False)
        writer.start("ros2", "a fast recorder")
        schema = writer.register_schema(POSES, "ros2msg", make.definition(POSES).encode())
        channel = writer.register_channel("/poses", "cdr", schema)
        for number in range(20):
            writer.add_message(channel, number, make.serialise(poses(make, number)), number)
        writer.finish()
    return path


def test_a_message_that_the_end_cuts_is_not_read(unchunked):
    """The mcap library alone would yield half a message."""
    assert len(list(read_records(unchunked))) == 20
    whole, counts = unchunked.read_bytes(), []
    for size in range(3000, 8000, 97):
        unchunked.write_bytes(whole[:size])
        found, error = read_until_damage(unchunked)
        assert error is not None and "ends too early" in str(error) and error.messages_read == len(found)
        assert all(len(message.poses) == 40 for _, message, _ in found)
        counts.append(len(found))
    assert len(set(counts)) > 2


@pytest.mark.parametrize(
    "described, clue", [((), "messages are of channel 1, which"), (("channel",), "message without type (cdr)")]
)
def test_a_message_that_the_file_does_not_describe(described, clue, tmp_path):
    path = tmp_path / "odd.mcap"
    with open(path, "wb") as file:
        writer = McapWriter(file, use_chunking=False, enable_crcs=False)
        writer.start("ros2", "an odd recorder")
        if described:
            writer.register_channel("/poses", "cdr", 0)
        writer.add_message(1, 0, bytes(8), 0)
        writer.finish()
    found, error = read_until_damage(path)
    assert not found and error is not None and clue in str(error)


def test_a_length_that_no_file_can_hold(unchunked):
    damaged = bytearray(unchunked.read_bytes())
    damaged[9:17] = (10**9).to_bytes(8, "little")  # of the header, the first record
    unchunked.write_bytes(damaged)
    _, error = read_until_damage(unchunked)
    assert "the length of a record is damaged" in str(error)


def test_bytes_after_the_end_are_noticed(unchunked):
    with open(unchunked, "ab") as file:
        file.write(b"x")
    found, error = read_until_damage(unchunked)
    assert len(found) == 20 and "goes on after the end mark" in str(error)


@pytest.mark.parametrize(
    "content, clue",
    [
        (b"", "empty"),
        (b"SQLite format 3\0" + bytes(100), "the database is damaged"),
        (b"#ROSBAG V2.0\n", "rosbags-convert --src"),
        (b"\x28\xb5\x2f\xfd" + bytes(9), "the compressed file is damaged"),
        (b"\x89MCAP0\r\n", "ends too early"),
        (b"\x89MC", "not an mcap or sqlite3 file"),
    ],
)
def test_other_files_are_refused(tmp_path, content, clue):
    path = tmp_path / "odd.mcap"
    path.write_bytes(content)
    found, error = read_until_damage(path)
    assert not found and clue in str(error) and str(path) in str(error)


def test_missing_bag(tmp_path):
    with pytest.raises(BagError, match="no such file or folder"):
        list(read_messages(tmp_path / "nowhere.mcap"))


def test_folder_without_mcap(tmp_path):
    (tmp_path / "notes.txt").write_bytes(b"")
    with pytest.raises(BagError, match="no recording in this folder"):
        list(read_messages(tmp_path))


def test_bag_of_another_writer_with_a_type_nobody_installed(tmp_path):
    """The definition embedded in the bag is all that is needed."""
    store = get_typestore(Stores.ROS2_JAZZY)
    definitions = {
        "odd_msgs/msg/Inner": "float32[3] xyz\n",
        "odd_msgs/msg/Outer": "odd_msgs/Inner[] parts\nstring name\n",
    }
    make = BagMessages(definitions)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    inner = make("odd_msgs/msg/Inner", xyz=np.array([1, 2, 3], np.float32))
    outer = make("odd_msgs/msg/Outer", parts=[inner, inner], name="x")
    with Writer(tmp_path / "foreign", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/odd", "odd_msgs/msg/Outer", typestore=store)
        writer.write(connection, 5, store.serialize_cdr(outer, "odd_msgs/msg/Outer"))
    [(topic, kind, message, time)] = read_messages(tmp_path / "foreign")
    assert (topic, kind, time, message.name) == ("/odd", "odd_msgs/msg/Outer", 5, "x")
    assert message.parts[1].xyz.tolist() == [1, 2, 3]

    with BagWriter(tmp_path / "own.mcap", make) as bag:
        bag.write("/odd", outer, 6)
    assert next(read_messages(tmp_path / "own.mcap"))[2].parts[0].xyz.tolist() == [1, 2, 3]


def test_one_name_with_two_definitions(tmp_path):
    """Two bags from two versions of a package, read one after the other."""
    for field in ("int32 a\n", "string b\n"):
        make = BagMessages({"odd_msgs/msg/Thing": field})
        value = {"a": 3} if "a" in field else {"b": "three"}
        with BagWriter(tmp_path / "x.mcap", make) as bag:
            bag.write("/thing", make("odd_msgs/msg/Thing", **value), 1)
        [(_, _, message, _)] = read_messages(tmp_path / "x.mcap")
        assert {name: getattr(message, name) for name in value} == value


def test_bytes_that_do_not_fit_their_definition(tmp_path):
    with BagWriter(tmp_path / "x.mcap") as bag:
        bag.write_cdr("/poses", POSES, b"\x00\x01\x00\x00\x01\x02", 1)
    with pytest.raises(BagError, match="does not decode"):
        list(read_messages(tmp_path / "x.mcap"))


def test_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    make = BagMessages()
    with pytest.raises(RuntimeError):
        with BagWriter(path, make) as bag:
            bag.write("/poses", poses(make, 0), 0)
            raise RuntimeError
    assert path.read_bytes() == b"precious"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_nothing(tmp_path):
    (tmp_path / "a.mcap").symlink_to("/dev/full")
    assert is_stream(tmp_path / "a.mcap")
    with pytest.raises(OutputError, match="cannot write .*a.mcap: No space left"):
        write(tmp_path / "a.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"] and Path("/dev/full").is_char_device()


@pytest.mark.parametrize("path, clue", [("", "it is a folder"), ("file/a.mcap", "cannot write .*file/a.mcap: ")])
def test_where_nothing_can_be_written(tmp_path, path, clue):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=clue):
        write(tmp_path / path)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_killed_recorder_leaves_all_but_the_last_chunk(tmp_path):
    make = BagMessages()
    bag = BagWriter(tmp_path / "a.mcap", make).__enter__()
    for number in range(300):
        bag.write("/poses", poses(make, number), number)
    [part] = tmp_path.glob("a.mcap.*.part")
    found, error = read_until_damage(part)  # the file as a kill -9 would leave it now, less what the OS still holds
    assert error is not None
    assert not bag.path.exists()
    assert 300 - len(found) < 64  # a chunk is 64 KiB, a message 2.3 KB, and Python buffers no more than that again
