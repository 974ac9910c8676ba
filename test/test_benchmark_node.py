# SPDX-License-Identifier: Apache-2.0
"""`paul benchmark node`: a short run of the real processes, what is sent, and the arithmetic of what comes back."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import ROOT

import msg_adapters
from paul_ros import cli
from paul_ros.benchmarks import node, node_messages, node_processes
from paul_ros.benchmarks.node import memory_growth, ratios, row
from paul_ros.benchmarks.node_messages import clouds, spread
from paul_ros.benchmarks.node_processes import Turn, cpu_seconds
from paul_ros.benchmarks.node_report import table
from paul_ros.benchmarks.traffic import NODES
from paul_ros.errors import BagError
from paul_ros.offline.bag_records import jazzy_typestore

KEYS = {
    "node",
    "persons",
    "rate_hz",
    "sent",
    "received",
    "latency_median_us",
    "latency_p99_us",
    "cpu_us_per_frame",
    "rss_mb",
}
CLOUD = "sensor_msgs/msg/PointCloud2"


def children() -> set[int]:
    """Ids of the processes that this one has started and that are not gone."""
    return {int(pid) for pid in open(f"/proc/self/task/{os.getpid()}/children").read().split()}


def test_a_short_run(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(node, "STARTS", 1)
    files = [tmp_path / "node.json", tmp_path / "node.png"]
    before = children()
    words = ["benchmark", "node", "--persons", "1", "--rates", "30", "--seconds", "1"]
    assert cli.main([*words, "--json", str(files[0]), "--plot", str(files[1])]) == 0
    report, printed = json.loads(files[0].read_text()), capsys.readouterr()
    assert children() == before
    assert files[1].read_bytes().startswith(b"\x89PNG")
    assert [found["node"] for found in report["rows"]] == list(NODES)
    for found in report["rows"]:
        assert KEYS == set(found)
        assert found["sent"] == found["received"] == 30
        assert 50 < found["latency_median_us"] <= found["latency_p99_us"]
        assert 50 < found["cpu_us_per_frame"] < 100_000
        assert 20 < found["rss_mb"] < 500
        assert 0.1 < report["start_to_first_output_s"][found["node"]] < 30
    lifter, echo = report["rows"]
    (ratio,) = report["ratios"]
    assert ratio["latency_median_ratio"] == lifter["latency_median_us"] / echo["latency_median_us"]
    shown = next(line.split() for line in printed.out.splitlines() if " lifter " in line)
    assert shown[5] == f"{lifter['latency_median_us']:.0f}" and shown[9] == f"{ratio['latency_median_ratio']:.2f}"
    assert "start to first output" in printed.out
    assert report["machine"]["cpus"] == os.cpu_count() and report["versions"]["rclpy"]


def test_a_short_soak(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(node, "first_outputs", lambda: {"lifter": 0.5})
    monkeypatch.setattr(node, "SOAK_SECONDS", 0.5)
    files = [tmp_path / "soak.json", tmp_path / "soak.png"]
    words = ["benchmark", "node", "--persons", "1,3", "--rates", "40,20", "--soak", "0.025"]
    assert cli.main([*words, "--json", str(files[0]), "--plot", str(files[1])]) == 0
    report = json.loads(files[0].read_text())
    (found,) = report["rows"]
    assert (found["node"], found["persons"], found["rate_hz"]) == ("lifter", 3, 40)
    assert found["sent"] == found["received"] == pytest.approx(60, abs=25)
    assert len(report["soak"]["memory"]) >= 3
    assert "MB an hour" in capsys.readouterr().out and files[1].read_bytes().startswith(b"\x89PNG")


def test_a_node_that_cannot_start_is_reported(monkeypatch, capsys):
    monkeypatch.setitem(node_processes.MODULES, "lifter", "paul_ros.benchmarks.none_such")
    before = children()
    assert cli.main(["benchmark", "node"]) == 1
    assert children() == before
    printed = capsys.readouterr().err.splitlines()[-1]
    assert printed.startswith("paul: the lifter ended by itself (1)") and "none_such" in printed


def test_without_ros_the_error_names_the_cure(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert cli.main(["benchmark", "node"]) == 1
    printed = capsys.readouterr().err.splitlines()[-1]
    assert "the benchmark needs ROS 2" in printed and "pip install '.[ros]' in a clone" in printed


def test_without_the_recording_the_error_names_the_cure(monkeypatch, capsys):
    def missing(name):
        raise BagError(f"the recording '{name}' is not installed")

    monkeypatch.setattr(node_messages, "find_bag", missing)
    assert cli.main(["benchmark", "node"]) == 1
    assert "is not installed" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["--persons", "0"], ["--persons", "1,1"], ["--rates", "fast"], ["--seconds", "-1"], ["--soak", "nan"]]
)
def test_odd_settings_are_refused(words, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["benchmark", "node", *words])
    assert end.value.code == 2 and words[0] in capsys.readouterr().err


def test_clouds_are_what_the_adapter_reads():
    sent = clouds(3)
    assert sent.shape[0] == 60
    read = msg_adapters.read(CLOUD, jazzy_typestore().deserialize_cdr(sent[7].tobytes(), CLOUD), 17)
    assert read.persons == 3 and read.visible.all() and read.ids == ("0", "1", "2")
    assert read.stamp == 0 and read.frame_id == "camera_color_optical_frame"


@pytest.mark.parametrize("persons", [1, 2, 7, 50])
def test_persons_are_spread_over_the_image(persons):
    poses = np.random.default_rng(1).normal(300, 60, (200, 17, 2))
    xy = spread(poses, persons)
    assert xy.shape == (60, persons, 17, 2)
    assert (xy >= 0).all() and (xy <= (1280, 720)).all()
    low, high = xy.min(axis=2), xy.max(axis=2)
    apart = (low[:, :, None] > high[:, None]).any(-1) | (low[:, None] > high[:, :, None]).any(-1)
    assert (apart | np.eye(persons, dtype=bool)).all()
    # Same shape as the recorded pose, but for size and place.
    flat = (xy[0, 0] - xy[0, 0].mean(0)).ravel(), (poses[0] - poses[0].mean(0)).ravel()
    assert np.dot(*flat) == pytest.approx(np.linalg.norm(flat[0]) * np.linalg.norm(flat[1]))


def test_a_row():
    turns = [Turn(5, np.array([100.0, 300.0, 200.0]), 0.001), Turn(5, np.array([400.0, 500.0]), 0.002)]
    found = row("echo", 2, 30, turns, 60.5)
    assert found["sent"] == 10 and found["received"] == 5
    assert found["latency_median_us"] == 300 and found["latency_p99_us"] == pytest.approx(496)
    assert found["cpu_us_per_frame"] == pytest.approx(600)
    assert set(found) == KEYS


def test_a_node_that_answers_nothing_has_no_figures():
    silent = row("lifter", 1, 30, [Turn(5, np.zeros(0), 0.5)], 60.5)
    assert silent["received"] == 0
    assert [silent[key] for key in ("latency_median_us", "latency_p99_us", "cpu_us_per_frame")] == [None] * 3
    rows = [silent, row("echo", 1, 30, [Turn(5, np.ones(5), 0.5)], 60.5)]
    assert set(ratios(rows)[0].values()) == {1, 30, None}
    head = {"start_to_first_output_s": {}, "machine": {"processor": "?", "cpus": 1, "load_before": 0, "load_after": 0}}
    shown = table({**head, "rows": rows, "ratios": ratios(rows)})
    assert "-" in shown.splitlines()[1] and " - 1 persons at 30 Hz: a node answered no message" in shown


def test_ratios_are_of_the_same_persons_and_rate():
    def of(name, persons, latency, cpu):
        return row(name, persons, 30, [Turn(2, np.array([latency, latency]), 2 * cpu)], 60.0)

    rows = [of("lifter", 1, 300.0, 5e-4), of("echo", 10, 900.0, 1e-4), of("lifter", 10, 990.0, 9e-4)]
    rows.append(of("echo", 1, 200.0, 2e-4))
    one, ten = ratios(rows)
    assert (one["persons"], one["latency_median_ratio"]) == (1, 1.5)
    assert one["cpu_added_us_per_frame"] == pytest.approx(300)
    assert (ten["persons"], ten["latency_p99_ratio"]) == (10, pytest.approx(1.1))
    assert ten["cpu_added_us_per_frame"] == pytest.approx(800)


def test_memory_growth_is_that_of_the_second_half():
    flat = [(float(s), 80.0 if s >= 50 else 60.0) for s in range(0, 101, 10)]
    assert memory_growth(flat) == {"rss_mb_max": 80.0, "growth_mb_per_hour": pytest.approx(0, abs=1e-9)}
    leak = [(float(s), 60.0 + s / 3600) for s in range(0, 101, 10)]
    assert memory_growth(leak)["growth_mb_per_hour"] == pytest.approx(1)
    assert memory_growth([(0.0, 60.0)])["growth_mb_per_hour"] is None


def test_cpu_time_of_another_process():
    code = "import sys, time\nwhile time.process_time() < 0.2: pass\nprint(time.process_time(), flush=True)\ninput()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        printed = float(child.stdout.readline())
        time.sleep(0.05)
        assert printed <= cpu_seconds(child.pid) < printed + 0.05
        child.communicate(b"\n")


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_every_process(kind):
    """It comes to the command alone, as from another program: nobody is left behind."""
    command = subprocess.Popen(
        [sys.executable, "-m", "paul_ros.cli", "benchmark", "node", "--seconds", "60"],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background has it ignored
    )
    try:
        end = time.monotonic() + 30
        while len(group(command.pid)) < 4:
            assert time.monotonic() < end and command.poll() is None
            time.sleep(0.05)
        command.send_signal(kind)
        assert command.wait(30) == 128 + kind
        assert command.stderr.read().strip() == b"paul: stopped"
        assert not group(command.pid)
    finally:
        command.kill()
        command.wait()
        command.stderr.close()


def group(session: int) -> list[int]:
    """Ids of the processes of a session."""
    found = []
    for pid in filter(str.isdecimal, os.listdir("/proc")):
        try:
            fields = open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(pid))
    return found
