# SPDX-License-Identifier: Apache-2.0
"""Faults around the node and while recording: publishers that die, floods, full disks, kills."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ROOT, camera_info, header_of
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
from node_bench import MAKE, PATIENCE, Bench, good
from test_node import half_way

from paul_ros.errors import BagError
from paul_ros.offline.bag_reader import read_messages, topics_of

ONE, TWO = ROOT / "bags/one_person.mcap", ROOT / "bags/two_persons_crossing.mcap"
#: Publishes a good cloud COUNT times at RATE Hz with stamps from FIRST on, after the node has answered one.
PUBLISHER = """
import os, sys, time
domain = os.environ["ROS_DOMAIN_ID"]
from conftest import RosMake, header_of  # which chooses another
from node_bench import class_of, good
os.environ["ROS_DOMAIN_ID"] = domain
import rclpy
from geometry_msgs.msg import PoseArray

namespace, rate, first, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
rclpy.init()
node = rclpy.create_node("publisher", namespace=namespace)
publisher = node.create_publisher(class_of("sensor_msgs/msg/PointCloud2"), "keypoints", 10)
answers = []
node.create_subscription(PoseArray, "lifter/poses", answers.append, 10)
message, sent = good()(header_of(RosMake())), 0

def publish():
    global sent
    message.header.stamp.sec = first + sent
    publisher.publish(message)
    sent += 1

while not any(first <= answer.header.stamp.sec < first + 1000 for answer in answers):
    publish()
    rclpy.spin_once(node, timeout_sec=0.1)
print(sent, flush=True)
due = time.monotonic()
for _ in range(count):
    publish()
    due += 1 / rate
    time.sleep(max(due - time.monotonic(), 0))
# A loss shows when the next message comes.
for _ in range(5):
    time.sleep(0.1)
    publish()
print(sent, flush=True)
rclpy.spin(node)
"""


class Publisher:
    """A publisher in its own process; its stamps count seconds from `first` on."""

    def __init__(self, namespace: str, rate: float, first: int, count: int) -> None:
        env = {key: value for key, value in os.environ.items() if key != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        env["PYTHONPATH"] = os.pathsep.join((str(ROOT), str(ROOT / "test"), env.get("PYTHONPATH", "")))
        # A killed process would leave shared memory behind.
        env["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
        arguments = [namespace, *map(str, (rate, first, count))]
        self.process = subprocess.Popen(
            [sys.executable, "-c", PUBLISHER, *arguments], cwd=ROOT, env=env, stdout=subprocess.PIPE, text=True
        )

    def next_count(self) -> int:
        """Return the next number that it prints."""
        return int(self.process.stdout.readline())

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE)
        self.process.stdout.close()


@pytest.fixture
def start_publisher():
    started: list[Publisher] = []

    def start(*arguments) -> Publisher:
        started.append(Publisher(*arguments))
        return started[-1]

    yield start
    for publisher in started:
        if publisher.process.poll() is None:
            publisher.kill()


def heard(bench: Bench, first: int) -> list[int]:
    """Return the stamps of the poses that answer one publisher."""
    seconds = (message.header.stamp.sec for message in bench.got["poses"])
    return [second for second in seconds if first <= second < first + 1_000_000]


@pytest.fixture
def bench(ros, start_lifter, model_file):
    bench = Bench(ros, start_lifter("-p", f"model:={model_file}"))
    bench.until(bench.keypoints.get_subscription_count, "a subscription")
    yield bench
    bench.close()


def settled(bench: Bench) -> dict:
    """Return diagnostics after the last frame has been lifted."""
    before = None
    while (now := bench.diagnosed())["frames"] != before:
        before = now["frames"]
    return now


def test_a_publisher_that_is_killed_and_another_that_comes(bench, start_publisher):
    dies = start_publisher(bench.lifter.namespace, 100, 1_000_000, 10**6)
    bench.until(lambda: len(heard(bench, 1_000_000)) > 20, "answers to the first")
    dies.kill()
    start_publisher(bench.lifter.namespace, 100, 2_000_000, 10**6)
    bench.until(lambda: len(heard(bench, 2_000_000)) > 20, "answers to the second")
    found = bench.diagnosed()
    assert "dropped_internal_error" not in found
    # The second publisher's sequence numbers start at one again: that is no loss.
    assert int(found.get("dropped_missed", 0)) < int(found["frames"])
    bench.lifts()


def test_two_publishers_at_once_are_both_lifted(bench, start_publisher):
    """A detector that was started twice by mistake breaks nothing, and no loss is invented."""
    firsts = (1_000_000, 2_000_000)
    for first in firsts:
        start_publisher(bench.lifter.namespace, 50, first, 10**6)
    for first in firsts:
        bench.until(lambda: len(heard(bench, first)) > 50, f"answers to {first}")
    found = bench.diagnosed()
    assert {key for key in found if key.startswith("dropped_")} <= {"dropped_missed"}
    assert int(found["noted_stamp_backwards"]) > 10
    bench.lifts()


@pytest.mark.parametrize("silent", [0, 1], ids=["alone", "beside one that is silent"])
def test_a_flood_into_a_slow_subscriber_loses_nothing_uncounted(bench, start_publisher, silent):
    """One core may not manage 1000 Hz, and this process takes one message every 20 ms."""
    if not silent:
        bench.node.destroy_publisher(bench.keypoints)
    flood = start_publisher(bench.lifter.namespace, 1000, 1_000_000, 1500)
    warm = flood.next_count()
    while flood.process.poll() is None and len(heard(bench, 1_001_500)) < 2:
        time.sleep(0.02)
        bench.ros.spin_once(bench.node, timeout_sec=0)
    sent = flood.next_count()
    found = settled(bench)
    frames, missed = int(found["frames"]), int(found.get("dropped_missed", 0))
    # One gap may be taken for the first number of the other publisher; a gap is shorter than the queues.
    assert sent - warm - 50 * silent < frames + missed <= sent, found
    assert frames > 200 and "dropped_internal_error" not in found


@pytest.mark.parametrize("topic", ["keypoints", "camera", "depth"])
def test_bytes_that_are_no_message_do_not_stop_the_node(bench, topic):
    """As from a publisher with another definition of the type."""
    from rclpy.serialization import serialize_message

    publisher = getattr(bench, topic)
    bench.matched()
    whole = {
        "keypoints": good()(header_of(MAKE)),
        "camera": camera_info(MAKE),
        "depth": half_way(1),
    }[topic]
    data, rng = serialize_message(whole), random.Random(1)
    for number in range(30):
        cut = data[: 4 + rng.randrange(len(data) - 4)] if number % 2 else data[:4] + rng.randbytes(60)
        publisher.publish(cut)
        bench.ros.spin_once(bench.node, timeout_sec=0.01)
    bench.lifts()
    assert "Traceback" not in bench.lifter.log()


# --- recording


def recorded(path: Path) -> int:
    """Return the number of messages read from a file that may end anywhere."""
    count = 0
    try:
        for _ in read_messages(path):
            count += 1
    except BagError as error:
        assert error.messages_read == count
    return count


def recovered(path: Path) -> int:
    """The same by mcap's stream reader, which recovery tools are made of."""
    count = 0
    with open(path, "rb") as stream:
        try:
            for record in StreamReader(stream).records:
                count += isinstance(record, Message)
        except (McapError, EOFError):
            pass
    return count


def on_a_full_disk(code: str, *arguments: object) -> subprocess.CompletedProcess:
    """Run Python code in a process that cannot write more than 300 kB to a file, as on a full disk."""
    limited = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n" + code
    command = [sys.executable, "-c", limited, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)


def test_a_full_disk_while_recording_is_one_line(tmp_path):
    out = tmp_path / "lifted.mcap"
    code = "import sys; from paul_ros.cli import main; sys.exit(main())"
    answer = on_a_full_disk(code, "replay", ONE, "-o", out)
    assert answer.returncode == 1
    [line] = [line for line in answer.stderr.splitlines() if line.startswith("paul: ")]
    assert line == f"paul: cannot write {out}: File too large" and "Traceback" not in answer.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_old_file_and_names_it(tmp_path):
    out = tmp_path / "report.json"
    out.write_bytes(b"precious")
    code = "import sys; from paul_ros.files import write_atomically; write_atomically(sys.argv[1], bytes(10**6))"
    answer = on_a_full_disk(code, out)
    assert answer.returncode == 1 and f"File too large: '{out}'" in answer.stderr.splitlines()[-1]
    assert out.read_bytes() == b"precious" and list(tmp_path.iterdir()) == [out]


def start_replay(out: Path, bag: Path = ONE) -> subprocess.Popen:
    words = [sys.executable, "-m", "paul_ros.cli", "replay", str(bag), "-o", str(out)]
    return subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def test_a_recording_that_is_killed_is_readable(tmp_path):
    out, parts = tmp_path / "lifted.mcap", []
    process = start_replay(out)
    end = time.monotonic() + PATIENCE
    while not (parts and parts[0].stat().st_size > 300_000):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.001)
        parts = list(tmp_path.glob("lifted.mcap.*.part"))
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert not out.exists()
    [part] = parts
    whole = sum(count for _, count in topics_of(ONE).values())
    assert 100 < recorded(part) < 5 * whole
    assert recovered(part) == recorded(part)
    assert "/lifter/poses" in {topic for topic, *_ in lenient(part)}


def test_two_recordings_of_one_name_are_both_whole(tmp_path):
    """The one that ends last stays. Both replay the same bag, so the files are equal."""
    out, alone = tmp_path / "lifted.mcap", tmp_path / "alone.mcap"
    both = [start_replay(out, TWO) for _ in range(2)]
    for process in both:
        assert process.communicate(timeout=PATIENCE)[1] == "" and process.returncode == 0
    assert start_replay(alone, TWO).wait(PATIENCE) == 0
    assert out.read_bytes() == alone.read_bytes()
    assert {file.name for file in tmp_path.iterdir()} == {"alone.mcap", "lifted.mcap"}


def lenient(path: Path):
    try:
        yield from read_messages(path)
    except BagError:
        return
