# SPDX-License-Identifier: Apache-2.0
"""Recordings as robots leave them: splits, lost files, other storages and compressions, foreign channels."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import sqlite3
from collections import Counter

import foreign_messages as foreign
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters.definitions import definitions
from paul_ros.errors import BagError, WrongTopicError
from paul_ros.offline.bag_reader import Recording, read_messages, read_records, topics_of
from paul_ros.offline.bag_records import BagMessages, Record
from paul_ros.offline.bag_topics import Topics
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.inspection import inspect
from paul_ros.offline.mcap_frames import Frames
from paul_ros.offline.replay import replay
from paul_ros.stream.stream import open_stream

WORDS = "std_msgs/msg/String"
CAMERA = "sensor_msgs/msg/CameraInfo"
SECOND = 10**9


def word(number: int, topic: str = "/words", second: float = 0.0, padding: int = 200) -> Record:
    """A message that says its number, at number/10 seconds after `second`."""
    make = BagMessages()
    data = make.serialise(make(WORDS, data=f"{number} " + "x" * padding))
    time = round((second + number / 10) * SECOND)
    return Record(topic, WORDS, data, time, make.definition(WORDS))


def write(path, records, chunk=1000, compression="zstd", finish=True):
    """Write records as another tool would: small chunks, an index, no checksum of the data section."""
    with open(path, "wb") as file:
        packing = CompressionType[compression.upper()]
        writer = McapWriter(file, chunk_size=chunk, compression=packing, use_chunking=bool(chunk))
        writer.start("ros2", "a recorder")
        channels: dict[str, int] = {}
        for record in records:
            if record.topic not in channels:
                schema = writer.register_schema(record.type_name, record.encoding, record.definition.encode())
                channels[record.topic] = writer.register_channel(record.topic, "cdr", schema)
            writer.add_message(channels[record.topic], record.log_time, record.data, record.log_time)
        if finish:
            writer.finish()
    return path


def numbers(path, topics=None):
    """The numbers of the words that come out, and the error at the end or None."""
    found = []
    try:
        for _, _, message, _ in read_messages(path, topics):
            found.append(int(message.data.split()[0]))
    except BagError as error:
        return found, error
    return found, None


def cut(path, share=0.5):
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def splits(folder, count=12, each=20, name="rec_{}.mcap"):
    """Files of one recording: file k holds the words 20 k to 20 k + 19."""
    folder.mkdir(exist_ok=True)
    return [write(folder / name.format(k), [word(n) for n in range(k * each, (k + 1) * each)]) for k in range(count)]


# --- the order of messages


def test_order_is_that_of_log_times_not_of_bytes(tmp_path):
    records = [word(n, f"/topic{n % 3}") for n in range(90)]
    by_topic = sorted(records, key=lambda record: record.topic)
    shuffled = random.Random(1).sample(records, 90)
    for number, some in enumerate((by_topic, shuffled, records[::-1])):
        for chunk in (0, 600, 10**6):
            path = write(tmp_path / f"{number}_{chunk}.mcap", some, chunk)
            assert numbers(path) == (list(range(90)), None)


def test_equal_log_times_keep_their_order_but_cameras_come_first(tmp_path):
    make = BagMessages()
    camera = Record("/camera_info", CAMERA, bytes(8), 0, make.definition(CAMERA))
    records = [word(n, second=-n / 10) for n in range(30)]
    path = write(tmp_path / "a.mcap", [*records, camera])
    found = list(read_records(path))
    assert found[0].topic == "/camera_info" and {record.log_time for record in found} == {0}
    assert [int(r.message().data.split()[0]) for r in found[1:]] == list(range(30))


def test_a_summary_is_not_needed_for_the_order(tmp_path):
    """The channel of a late message is described in an early chunk, or the other way round."""
    records = [word(n, "/a", second=5) for n in range(20)] + [word(n, "/b") for n in range(20)]
    records += [word(20 + n, "/a", second=-2) for n in range(20)]
    path = write(tmp_path / "a.mcap", records, finish=False)
    found, error = numbers(path)
    assert "ends too early" in str(error)
    assert len(found) > 40
    times = []
    with pytest.raises(BagError):
        for record in read_records(path):
            times.append(record.log_time)
    assert times == sorted(times)


@pytest.mark.parametrize("name", ["rec_{}.mcap", "{}_rec.mcap", "{}_rosbag2_2025_06_10-12_00_00.mcap", "a b#ü_{}.mcap"])
def test_splits_without_metadata_come_in_the_order_of_time(tmp_path, name):
    splits(tmp_path / "rec", name=name)
    assert numbers(tmp_path / "rec") == (list(range(240)), None)


def test_metadata_names_the_files_but_time_orders_them(tmp_path):
    folder = tmp_path / "rec"
    splits(folder, 3)
    (folder / "rec_2.mcap").rename(folder / "after.mcap")
    listing(folder, "after.mcap", "old/rec_0.mcap", "/home/robot/rec_1.mcap", "rec_0.mcap")
    assert numbers(folder) == (list(range(60)), None)
    assert numbers(folder / "metadata.yaml") == (list(range(60)), None)


def listing(folder, *names):
    text = "rosbag2_bagfile_information:\n  relative_file_paths:\n" + "".join(f"  - {name}\n" for name in names)
    (folder / "metadata.yaml").write_text(text)


def test_splits_that_overlap_a_little_are_merged(tmp_path):
    def owner(number):
        """Return the file of a word; those around a border change places."""
        return min((number + 5 * (number % 2)) // 20, 3)

    for k in range(4):
        write(tmp_path / f"rec_{k}.mcap", [word(n) for n in range(80) if owner(n) == k])
    assert numbers(tmp_path) == (list(range(80)), None)


@pytest.mark.parametrize("metadata", ["", "rosbag2_bagfile_information:\n  rela", "[]", "\x00\x01", "a: *b", "- " * 9])
def test_half_written_metadata_is_as_none(tmp_path, metadata):
    splits(tmp_path / "rec", 3)
    (tmp_path / "rec/metadata.yaml").write_text(metadata)
    assert numbers(tmp_path / "rec") == (list(range(60)), None)


# --- damage and loss


def test_damage_ends_a_file_not_the_recording(tmp_path):
    files = splits(tmp_path / "rec")
    cut(files[2])
    files[7].write_bytes(b"")
    files[9].write_bytes(b"rubbish, not even a file's start")
    found, error = numbers(tmp_path / "rec")
    whole = set(range(240)) - set(range(40, 60)) - set(range(140, 160)) - set(range(180, 200))
    assert whole < set(found) < whole | set(range(40, 60)) and found == sorted(found)
    assert "3 of 12 files are damaged or missing" in str(error) and error.messages_read == len(found)
    for name, cause in (("rec_2", "ends too early"), ("rec_7", "empty"), ("rec_9", "not an mcap")):
        assert f"{name}.mcap: " in str(error) and cause in str(error)
    assert str(error).count("rec_2.mcap") == 1 and "rec_3" not in str(error) and "\n" not in str(error)


def test_missing_files_are_named(tmp_path):
    files = splits(tmp_path / "rec", 4)
    listing(tmp_path / "rec", *(file.name for file in files))
    files[1].unlink()
    found, error = numbers(tmp_path / "rec")
    assert len(found) == 60 and "1 of 4 files is damaged or missing: rec_1.mcap: missing" in str(error)
    (tmp_path / "rec/metadata.yaml").unlink()  # then the numbers tell
    found, error = numbers(tmp_path / "rec")
    assert len(found) == 60 and "rec_1.mcap: missing" in str(error)
    files[0].unlink()  # a part of a recording: nobody knows what came before
    assert numbers(tmp_path / "rec") == (list(range(40, 80)), None)


def test_files_that_metadata_lacks_belong_by_name_and_time(tmp_path):
    files = splits(tmp_path / "rec", 4)
    listing(tmp_path / "rec", "rec_0.mcap", "rec_1.mcap")
    write(tmp_path / "rec/lifted.mcap", [word(7)])
    assert numbers(tmp_path / "rec") == (list(range(40)), None)  # beside another file the list alone counts
    (tmp_path / "rec/lifted.mcap").unlink()
    assert numbers(tmp_path / "rec") == (list(range(80)), None)
    write(files[3], [word(n) for n in range(50)])
    assert numbers(tmp_path / "rec") == (list(range(40)), None)


def test_all_listed_files_are_missing(tmp_path):
    splits(tmp_path / "rec", 1)
    listing(tmp_path / "rec", "other_0.mcap")
    found, error = numbers(tmp_path / "rec")
    assert len(found) == 20 and "other_0.mcap: missing" in str(error)


def test_a_file_is_read_on_behind_every_kind_of_damage(tmp_path):
    """A chunk, the frame of a chunk, a stretch of zeros, the index: only what is damaged is lost."""
    path = write(tmp_path / "a.mcap", [word(n, padding=2000) for n in range(60)], 5000, "none")
    whole = path.read_bytes()
    with open(path, "rb") as stream:
        places = [block.start for block in Frames(stream).blocks]
    assert len(places) > 10
    broken = {
        "content": (places[3] + 3000, b"\xff"),
        "length": (places[3] + 1, b"\xff\xff\xff"),
        "huge length": (places[3] + 1, b"\xff" * 8),
        "opcode": (places[3], b"\x00"),
        "zeros": (places[3] + 100, bytes(4096)),
        "zeros over the frame": (places[3] - 50, bytes(4096)),
    }
    for kind, (at, put) in broken.items():
        path.write_bytes(whole[:at] + put + whole[at + len(put) :])
        found, error = numbers(path)
        assert error is not None and "damaged" in str(error), kind
        assert found == sorted(found) and 54 <= len(found) < 60, (kind, len(found))
        assert f"{len(found)} of 60 messages" in str(error) or "length" in kind or "zeros" in kind, (kind, str(error))


@pytest.mark.parametrize("size", [-1, -8, -9, -20, -60, -200])
def test_a_damaged_index_costs_no_message(tmp_path, size):
    path = write(tmp_path / "a.mcap", [word(n) for n in range(60)])
    whole = path.read_bytes()
    for changed in (whole[:size], whole[:size] + bytes([whole[size] ^ 4]) + whole[size:][1:]):
        path.write_bytes(changed)
        found, error = numbers(path)
        assert found == list(range(60)) and error is not None and "60 " in str(error)


@pytest.mark.parametrize("chunk", [0, 500])
@pytest.mark.parametrize(
    "lacking",
    [
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_summary_offsets": False, "enable_crcs": False},
        {"enable_data_crcs": True},
        {"index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False, "repeat_schemas": False},
    ],
)
def test_whatever_a_fast_recorder_leaves_out(tmp_path, chunk, lacking):
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = McapWriter(file, chunk_size=chunk, use_chunking=bool(chunk), **lacking)
        writer.start("ros2", "a fast recorder")
        channel = writer.register_channel("/words", "cdr", writer.register_schema(WORDS, "ros2msg", b"string data"))
        for number in range(60, 0, -1):
            writer.add_message(channel, number, word(number).data, number)
        writer.finish()
    assert numbers(tmp_path / "a.mcap") == (list(range(1, 61)), None)
    assert topics_of(tmp_path / "a.mcap") == {"/words": (WORDS, 60)}


@pytest.mark.parametrize("time", [-1, 2**63, 2**64 - 1])
def test_impossible_log_times(tmp_path, time):
    path = tmp_path / "a.mcap"
    if time > 0:
        odd = Record("/words", WORDS, word(1).data, time, word(1).definition)
        write(path, [word(0), odd, word(2)])
    else:
        path = next(rosbag2(tmp_path / "rec", StoragePlugin.SQLITE3, count=3).glob("*.db3"))
        with sqlite3.connect(path) as database:
            database.execute("UPDATE messages SET timestamp = -5 WHERE id = 2")
        database.close()
    found, error = numbers(path)
    assert found == [0, 2] and "no possible log time" in str(error)


def test_topics_without_messages_do_not_spoil_the_checksum(tmp_path):
    """mcap's writer leaves them out of it; the file is whole."""
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = McapWriter(file, use_chunking=False, enable_data_crcs=True)
        writer.start("ros2", "a recorder")
        schema = writer.register_schema(WORDS, "ros2msg", word(1).definition.encode())
        writer.add_message(writer.register_channel("/words", "cdr", schema), 1, word(1).data, 1)
        writer.register_channel("/empty", "cdr", schema)
        writer.finish()
    assert numbers(tmp_path / "a.mcap") == ([1], None)
    content = bytearray((tmp_path / "a.mcap").read_bytes())
    content[content.index(b"x" * 99)] = 0x79
    (tmp_path / "a.mcap").write_bytes(content)
    assert "the checksum of the data section is wrong" in str(numbers(tmp_path / "a.mcap")[1])


def test_messages_outside_chunks_are_read_on_too(tmp_path):
    path = write(tmp_path / "a.mcap", [word(n, padding=2000) for n in range(60)], 0)
    whole = bytearray(path.read_bytes())
    whole[50_000:54_000] = bytes(4000)
    path.write_bytes(whole)
    found, error = numbers(path)
    assert 56 <= len(found) < 60 and error is not None


# --- several recordings


def test_several_recordings_are_refused_with_their_paths(tmp_path):
    write(tmp_path / "one person.mcap", [word(1)])
    write(tmp_path / "two.mcap", [word(1)])
    for read in (read_records, topics_of, inspect):
        with pytest.raises(
            BagError, match="holds 2 recordings.*Give them one by one: `'.*one person.mcap'` or `.*`paul train` takes"
        ):
            list(read(tmp_path if read is not inspect else str(tmp_path)))


@pytest.mark.parametrize(
    "second, refused", [(0, True), (0.5, True), (2.0, False), (3.0, False), (3600, True), (-3600, True)]
)
def test_numbers_alone_make_no_splits(tmp_path, second, refused):
    """Takes of one name overlap by more than half, or lie far apart in time, or run backwards."""
    write(tmp_path / "take_1.mcap", [word(n) for n in range(20)])
    write(tmp_path / "take_2.mcap", [word(n, second=second + 4000) for n in range(20)])
    write(tmp_path / "take_1.mcap", [word(n, second=4000) for n in range(20)])
    found, error = numbers(tmp_path)
    assert (error is not None) == refused
    assert len(found) == (0 if refused else 40)


def test_numbered_files_that_do_not_follow_each_other_say_where_and_what_to_do(tmp_path):
    splits(tmp_path, 2)
    write(tmp_path / "rec_2.mcap", [word(n, second=500) for n in range(20)])
    with pytest.raises(
        BagError, match="rec_2.mcap begins 496 s after the end of rec_1.mcap.*`ros2 bag reindex -s mcap"
    ):
        Recording(tmp_path)
    listing(tmp_path, "rec_0.mcap", "rec_1.mcap", "rec_2.mcap")
    assert len(numbers(tmp_path)[0]) == 60


@pytest.mark.parametrize("listed", [True, False])
def test_a_copied_file_is_refused_by_name(tmp_path, listed):
    files = splits(tmp_path, 3)
    shutil.copy(files[1], tmp_path / "rec_3.mcap")
    if listed:
        listing(tmp_path, *(f"rec_{k}.mcap" for k in range(4)))
    with pytest.raises(BagError, match="rec_3.mcap is a copy of rec_1.mcap: move one"):
        Recording(tmp_path)


def test_folders_named_as_files(tmp_path):
    (tmp_path / "take.mcap").mkdir()
    splits(tmp_path / "take.mcap", 2, name="take.mcap_{}.mcap")
    assert numbers(tmp_path / "take.mcap") == (list(range(40)), None)
    with pytest.raises(BagError, match=f"lies in a folder of its own: give that, `{tmp_path}/take.mc"):
        Recording(tmp_path)


def test_nothing_but_the_list_is_left(tmp_path):
    listing(tmp_path, "rec_0.mcap")
    with pytest.raises(BagError, match=r"metadata.yaml lists are missing \(rec_0.mcap\): copy them"):
        Recording(tmp_path)


def test_a_folder_of_recordings_is_refused(tmp_path):
    splits(tmp_path / "monday", 2)
    (tmp_path / "tuesday").mkdir()
    (tmp_path / "tuesday/metadata.yaml").touch()
    with pytest.raises(BagError, match=f"holds 2 recordings.*`{tmp_path}/monday` or `{tmp_path}/tue"):
        Recording(tmp_path)


def test_files_that_are_still_written_count_only_alone(tmp_path):
    write(tmp_path / "rec.mcap", [word(1)])
    write(tmp_path / "other.mcap.part", [word(2)])
    assert numbers(tmp_path) == ([1], None)
    (tmp_path / "rec.mcap").unlink()
    assert numbers(tmp_path) == ([2], None)


# --- storages and compressions


def rosbag2(folder, storage, mode=None, count=50, types=True):
    """A recording as rosbag2 leaves it, by a writer of other people's making."""
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(folder, version=8, storage_plugin=storage)
    if mode:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/words", WORDS, typestore=store)
        for number in range(count):
            record = word(number)
            writer.write(connection, record.log_time, record.data)
    return folder


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("mode", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_every_storage_and_compression_of_rosbag2(tmp_path, storage, mode):
    folder = rosbag2(tmp_path / "rec", storage, mode)
    assert numbers(folder) == (list(range(50)), None)
    assert topics_of(folder) == {"/words": (WORDS, 50)}
    summary, damage = inspect(str(folder))
    [file] = summary["files"]
    assert damage is None and file["messages"] == 50 and file["storage"] == storage.name.lower()
    expected = {CompressionMode.FILE: "file: zstd", CompressionMode.MESSAGE: "messages: zstd"}
    assert file["compression"] == expected.get(mode)
    (folder / "metadata.yaml").unlink()
    assert numbers(folder) == (list(range(50)), None)
    assert numbers(next(folder.iterdir())) == (list(range(50)), None)


def test_the_file_was_packed_or_unpacked_since(tmp_path):
    files = splits(tmp_path / "rec", 2)
    listing(tmp_path / "rec", "rec_0.mcap", "rec_1.mcap.zstd")
    (tmp_path / "rec/rec_0.mcap.zstd").write_bytes(zstandard.compress(files[0].read_bytes()))
    files[0].unlink()
    assert numbers(tmp_path / "rec") == (list(range(40)), None)


def test_a_cut_compressed_file_gives_what_is_whole(tmp_path):
    path = write(tmp_path / "a.mcap", [word(n, padding=2000) for n in range(200)], compression="none")
    packed = tmp_path / "a.mcap.zstd"
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    whole = packed.read_bytes()
    packed.write_bytes(whole[: len(whole) * 3 // 4])
    found, error = numbers(packed)
    assert error is not None and found == list(range(len(found)))


def test_definitions_before_iron(tmp_path):
    """Humble's sqlite3 files hold no definitions and fewer columns."""
    folder = rosbag2(tmp_path / "rec", StoragePlugin.SQLITE3)
    [file] = folder.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
        database.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
        database.execute("ALTER TABLE topics DROP COLUMN offered_qos_profiles")
    database.close()
    assert numbers(folder) == (list(range(50)), None)


@pytest.mark.parametrize("name", ["plain.db3", "a b#c?d%e ü.db3"])
def test_names_are_no_part_of_the_database_address(tmp_path, name):
    folder = rosbag2(tmp_path / "rec", StoragePlugin.SQLITE3)
    shutil.copy(next(folder.glob("*.db3")), tmp_path / name)
    before = set(tmp_path.iterdir())
    assert numbers(tmp_path / name) == (list(range(50)), None) and set(tmp_path.iterdir()) == before


def test_a_damaged_database_gives_what_is_whole(tmp_path):
    folder = rosbag2(tmp_path / "rec", StoragePlugin.SQLITE3, count=400)
    [file] = folder.glob("*.db3")
    whole, written = file.read_bytes(), [record.data for record in read_records(folder)]
    for size in (len(whole) // 2, len(whole) - 1, len(whole) - 5000, len(whole) // 2 // 4096 * 4096):
        file.write_bytes(whole[:size])
        recording = Recording(folder)
        found = [record.data for record in recording.whole_records()]
        assert 100 < len(found) < 400 and all(data in written for data in found), size
        assert "ends too early" in str(recording.damage)
    middle = len(whole) // 2 // 4096 * 4096
    file.write_bytes(whole[:middle] + bytes(4096) + whole[middle + 4096 :])
    found, error = whole_numbers(folder)
    assert 350 < len(found) < 400 and found == sorted(found) and "the database is damaged" in str(error)


def whole_numbers(path):
    """As `numbers`, without messages that do not decode: SQLite has no checksums."""
    recording, found = Recording(path), []
    for record in recording.whole_records():
        with contextlib.suppress(BagError):
            found.append(int(record.message().data.split()[0]))
    return found, recording.damage


def test_a_write_ahead_log_is_read(tmp_path):
    """As beside a recorder that was killed."""
    folder = rosbag2(tmp_path / "rec", StoragePlugin.SQLITE3)
    [file] = folder.glob("*.db3")
    database = sqlite3.connect(file)
    database.execute("PRAGMA journal_mode = WAL")
    record = word(50)
    database.execute(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", (record.log_time, record.data)
    )
    database.commit()
    copy = tmp_path / "copy"
    copy.mkdir()
    for part in folder.glob("*.db3*"):
        shutil.copy(part, copy)
    database.close()
    assert numbers(copy) == (list(range(51)), None)


@pytest.mark.parametrize(
    "content, clue",
    [
        (b"#ROSBAG V2.0\n...", "rosbags-convert --src .*rec.bag --dst rec --dst-storage mcap"),
        (b"ROSX1234", r"ros2 bag convert -i .*rec.bag -o out.yaml.*output_bags: \[\{uri: rec_mcap, storage_id: mcap"),
    ],
)
def test_other_storages_name_the_command(tmp_path, content, clue):
    path = tmp_path / "rec.bag"
    path.write_bytes(content)
    for given in (path, tmp_path):
        with pytest.raises(BagError, match=clue):
            list(read_records(given))


def test_a_recording_of_any_name_is_inspected(tmp_path):
    file = write(tmp_path / "rec.mcap.bak", [word(1)])
    assert inspect(str(file))[0]["messages"] == 1


def test_a_packed_file_is_not_for_the_tools_of_mcap(tmp_path):
    content = write(tmp_path / "rec.mcap", [word(n, padding=5000) for n in range(99)]).read_bytes()
    packed = zstandard.ZstdCompressor().compress(content[:-2000])
    for name, data, advised in (("a.mcap", content[:-2000], True), ("a.mcap.zstd", packed, False)):
        (tmp_path / name).write_bytes(data)
        assert ("`mcap recover" in str(numbers(tmp_path / name)[1])) == advised


def test_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "loop.mcap").symlink_to("loop.mcap")
    (tmp_path / "gone.mcap").symlink_to("nowhere.mcap")
    for name in ("pipe.mcap", "loop.mcap", "gone.mcap", "none.mcap"):
        with pytest.raises(BagError, match="not a regular file|no such file|symbolic links"):
            list(read_records(tmp_path / name))
    real = write(tmp_path / "real.mcap", [word(1)])
    (tmp_path / "link.mcap").symlink_to(real)
    assert numbers(tmp_path / "link.mcap") == ([1], None)


# --- foreign channels and definitions that are not there


def foreign_channel(path, encoding, schema, topic="/events"):
    with open(path, "wb") as file:
        writer = McapWriter(file, chunk_size=500)
        writer.start("ros2", "a recorder")
        number = writer.register_schema(*schema) if schema else 0
        other = writer.register_channel(topic, encoding, number)
        own = writer.register_channel("/words", "cdr", writer.register_schema(WORDS, "ros2msg", b"string data"))
        for n in range(40):
            writer.add_message(other, n, b"{}", n)
            writer.add_message(own, n, word(n).data, n)
        writer.finish()
    return path


FOREIGN = {
    "json (json)": ("json", ("json", "jsonschema", b"{}")),
    "a.B (protobuf)": ("protobuf", ("a.B", "protobuf", b"\x00\xff\xfe")),
    "message without type (cdr)": ("cdr", None),
    "message without type (json)": ("json", None),
    "odd_msgs/Odd (ros1)": ("ros1", ("odd_msgs/Odd", "ros1msg", b"int32 a")),
    "message without type (unknown)": ("", None),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_channels_matter_only_if_asked_for(tmp_path, kind):
    path = foreign_channel(tmp_path / "a.mcap", *FOREIGN[kind])
    assert numbers(path, ["/words"]) == (list(range(40)), None)
    assert topics_of(path) == {"/events": (kind, 40), "/words": (WORDS, 40)}
    assert inspect(str(path))[0]["topics"]["/events"]["type"] == kind
    with pytest.raises(WrongTopicError, match=r"/events has the type "):
        replay(path, open_stream(), topics=Topics(keypoints="/events"))


def yolo_bag(path, texts, definition="", people=2):
    """A bag of detections whose definition was not recorded; `texts` are the definitions that were sent."""
    make = BagMessages(texts)
    types = make._store.types
    pixels = np.random.default_rng(1).uniform(100, 400, (people, 17, 2))

    def value(field_type):
        """Return an empty value of a field, so that any version of the type can be made."""
        kind, what = field_type
        if kind.name == "BASE":
            return "" if what[0] == "string" else (0.0 if what[0].startswith("float") else 0)
        if kind.name == "NAME":
            return blank(what)
        return []

    def blank(name, **given):
        fields = make._store.fielddefs[name][1]
        return types[name](**{field: given.get(field, value(kind)) for field, kind in fields})

    detections = []
    for n, person in enumerate(pixels):
        points = [
            blank("yolo_msgs/msg/KeyPoint2D", id=k + 1, point=blank("yolo_msgs/msg/Point2D", x=x, y=y), score=0.9)
            for k, (x, y) in enumerate(person.tolist())
        ]
        array = blank("yolo_msgs/msg/KeyPoint2DArray", data=points)
        detections.append(
            blank("yolo_msgs/msg/Detection", class_name="person", score=0.9, id=str(n + 1), keypoints=array)
        )
    message = blank(foreign.YOLO, detections=detections)
    with BagWriter(path) as bag:
        for n in range(3):
            bag.write_record(Record("/keypoints", foreign.YOLO, make.serialise(message), n, definition))
    return pixels


@pytest.mark.parametrize("version", [0, 1])
@pytest.mark.parametrize("definition", ["", "\n \n"])
def test_a_definition_that_was_recorded_empty(tmp_path, version, definition):
    pixels = yolo_bag(tmp_path / "a.mcap", definitions(foreign.YOLO)[version], definition)
    for _, _, message, _ in read_messages(tmp_path / "a.mcap"):
        found = [[(k.point.x, k.point.y) for k in person.keypoints.data] for person in message.detections]
        assert np.allclose(found, pixels)


def test_the_tests_definitions_are_known_too():
    """Every foreign type of the tests has a definition of the adapters that reads the same bytes."""
    for name in definitions_of_families():
        stores = [BagMessages(texts)._store.hash_rihs01(name) for texts in definitions(name)]
        assert BagMessages(foreign.DEFINITIONS)._store.hash_rihs01(name) in stores, name


def definitions_of_families():
    return [name for name in foreign.DEFINITIONS if definitions(name)]


def test_another_version_is_not_misread(tmp_path):
    odd = dict(definitions(foreign.YOLO)[1])
    odd["yolo_msgs/msg/KeyPoint2D"] = "int32 id\nfloat32 extra\nyolo_msgs/Point2D point\nfloat64 score\n"
    yolo_bag(tmp_path / "a.mcap", odd)
    with pytest.raises(BagError, match="definition was not recorded. Install and source the package yolo_msgs where"):
        list(read_messages(tmp_path / "a.mcap"))


def test_a_recorded_hash_excludes_other_versions():
    texts = definitions(foreign.YOLO)[1]
    make = BagMessages(texts)
    empty = make(foreign.YOLO, header=header(make), detections=[])
    data = make.serialise(empty)
    right = make._store.hash_rihs01(foreign.YOLO)
    assert Record("/k", foreign.YOLO, data, 0, type_hash=right).message().detections == []
    with pytest.raises(BagError, match="was not recorded"):
        Record("/k", foreign.YOLO, data, 0, type_hash="RIHS01_" + "0" * 64).message()


def header(make):
    return make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=1, nanosec=0), frame_id="cam")


# --- inspection and memory


def test_inspection_tells_of_every_file(tmp_path):
    files = splits(tmp_path / "rec", 3)
    cut(files[1], 0.7)
    listing(tmp_path / "rec", *(file.name for file in files), "rec_3.mcap")
    summary, damage = inspect(str(tmp_path / "rec"))
    assert [file["file"] for file in summary["files"]] == [file.name for file in files]
    assert summary["missing"] == ["rec_3.mcap"] and "rec_3.mcap: missing" in str(damage)
    assert [bool(file["damage"]) for file in summary["files"]] == [False, True, False]
    assert summary["files"][2]["start_s"] == pytest.approx(4.0) and summary["files"][2]["end_s"] == pytest.approx(5.9)
    assert summary["start"] == "1970-01-01T00:00:00+00:00"
    assert sum(file["messages"] for file in summary["files"]) == summary["messages"]


def test_memory_does_not_grow_with_the_recording(tmp_path):
    """Written topic by topic, so that chunks of all topics are open at once."""
    import tracemalloc

    peaks = []
    for count in (300, 3000):
        records = [word(n, f"/topic{n % 3}", padding=1000) for n in range(count)]
        path = write(tmp_path / f"{count}.mcap", sorted(records, key=lambda record: record.topic), 20_000)
        del records
        list(Counter(record.topic for record in read_records(path)))  # caches are filled
        tracemalloc.start()
        assert sum(1 for _ in read_records(path)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0] < 300_000
