# SPDX-License-Identifier: Apache-2.0
"""`paul demo`: the real node is fed with recorded bags over DDS; its outputs are recorded, checked and judged."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from msg_adapters.keypoints import stamp_ns
from paul_ros.errors import DemoError
from paul_ros.files import write_json
from paul_ros.offline.bag_reader import read_messages
from paul_ros.offline.demo_live import LAYOUT, Live, run_live
from paul_ros.offline.judge import evaluate
from paul_ros.offline.picture import write_picture
from paul_ros.offline.replay import NODE_NAME, LiftedFrame, Replay
from paul_ros.offline.replay import replay as replay_bag
from paul_ros.offline.report import table
from paul_ros.offline.shipped_bags import find_bag
from paul_ros.offline.tables import Row
from paul_ros.output_files import check_output
from paul_ros.stream.stream import open_stream

BAGS = ("one_person", "two_persons_crossing")

#: Largest difference of live and replayed points, as a share of the skeleton's size.
AGREEMENT = 1e-6


def demo(out: Path, model: str | None = None) -> None:
    """Run the node on both bags, check its outputs, print tables and paths.

    Args:
        out: folder for the lifted bags, the pictures and report.json. The latter has the keys of `paul replay --json`
            for the first bag and, under its name, for the second. Its key `live` is about the node.
        model: name of a shipped model, or a path; None = the shipped human model.

    Raises:
        OutputError: the folder cannot be made.
        DemoError: the node fails, or its outputs differ from the replay.
        MissingPackageError: ROS 2 is not installed.
    """
    check_output(out / "report.json")
    reports, files = [], []
    for index, name in enumerate(BAGS):
        recording = out / ("lifted.mcap" if index == 0 else f"{name}_lifted.mcap")
        picture = out / ("picture.png" if index == 0 else f"{name}.png")
        replayed = replay_bag(find_bag(name), open_stream(model, LAYOUT))
        print(f"playing {name} to the node, {_seconds(replayed):.0f} s ...", file=sys.stderr, flush=True)
        live = run_live(replayed.bag, recording, model)
        done, agreement = compare(replayed, recording)
        reports.append(_report(done, live, agreement))
        write_picture(picture, done)
        print(table(reports[-1], _live_rows(reports[-1]["live"])) + "\n")
        files.append(f"{name}: {recording}, {picture}")
    write_json(out / "report.json", {**reports[0], **dict(zip(BAGS[1:], reports[1:]))})
    print("\n".join((*files, f"both: {out / 'report.json'}")))
    for name, report in zip(BAGS, reports):
        _require_agreement(name, report["live"])
    print(_verdict([report["live"] for report in reports]))


def compare(replayed: Replay, recording: Path) -> tuple[Replay, dict]:
    """Compare the live node with the replay, joined by header.stamp.

    Returns:
        The replay with the live points in place of its own, without the frames that the node lost. Then the agreement:

        - frames_lost, frames_unknown, frames_with_other_persons: counts.
        - order_kept: bool.
        - max_difference_relative: largest coordinate difference over the skeleton's size.
    """
    order, live = [], {}
    for _, _, message, _ in read_messages(recording, [f"{NODE_NAME}/poses"]):
        order.append(stamp_ns(message.header))
        live[order[-1]] = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 3)
    frames, differences, persons_differ = [], [0.0], 0
    for frame in replayed.frames:
        if frame.stamp not in live:
            continue
        expected = frame.lifted.points[frame.lifted.ok]
        if live[frame.stamp].size != expected.size:
            persons_differ += 1
            continue
        points = live[frame.stamp].reshape(expected.shape)
        differences += _relative_differences(points, expected)
        frames.append(_with_points(frame, points))
    return replace(replayed, frames=frames), {
        "frames_lost": sum(frame.stamp not in live for frame in replayed.frames),
        "frames_unknown": len(set(live) - {frame.stamp for frame in replayed.frames}),
        "frames_with_other_persons": persons_differ,
        "order_kept": order == sorted(set(order)),
        "max_difference_relative": max(differences),
    }


def _relative_differences(points: np.ndarray, expected: np.ndarray) -> list[float]:
    """Return each person's largest coordinate difference over the skeleton's largest extent."""
    size = np.ptp(expected, axis=1).max(axis=1)
    return (np.abs(points - expected).max(axis=(1, 2)) / size).tolist()


def _with_points(frame: LiftedFrame, points: np.ndarray) -> LiftedFrame:
    everyone = frame.lifted.points.copy()
    everyone[frame.lifted.ok] = points
    return replace(frame, lifted=replace(frame.lifted, points=everyone))


def _report(done: Replay, live: Live, agreement: dict) -> dict:
    report = {**evaluate(done), "lift_us_median": live.lift_us_median, "lift_us_p99": live.lift_us_p99}
    report["live"] = {
        "frames_sent": live.sent,
        "frames_received": live.received,
        **agreement,
        "start_to_ready_s": live.start_to_ready_s,
        "rss_mb": live.rss_mb,
    }
    return report


def _live_rows(live: dict) -> list[Row]:
    """Return the rows of the node below those of the replay."""
    order = "order kept" if live["order_kept"] else "ORDER BROKEN"
    frames = f"of {live['frames_sent']} sent, {live['frames_lost']} lost, {order}"
    return [
        ("node, start to ready", f"{live['start_to_ready_s']:.2f}", "", "s"),
        ("node, memory", live["rss_mb"], "", "MB"),
        ("node, frames", f"{live['frames_received']}", "", frames),
        (
            "live against replay",
            f"{live['max_difference_relative']:.1e}",
            "",
            "largest difference of a coordinate, over the person's size",
        ),
    ]


def _require_agreement(name: str, live: dict) -> None:
    if live["frames_lost"] or live["frames_unknown"]:
        raise DemoError(
            f"{name}: the node answered {live['frames_received']} of {live['frames_sent']} frames; "
            "repeat on an idle machine"
        )
    if not live["order_kept"] or live["frames_with_other_persons"] or live["max_difference_relative"] > AGREEMENT:
        raise DemoError(f"{name}: the outputs of the node differ from those of the replay; please report this")


def _verdict(lives: list[dict]) -> str:
    """Return the last line of a demo that passed."""
    sent, largest = sum(live["frames_sent"] for live in lives), max(live["max_difference_relative"] for live in lives)
    agreement = f"differs from replay by less than {AGREEMENT:g} of a person's size" if largest else "equals replay"
    return f"demo passed: live output {agreement}, 0 of {sent} messages lost"


def _seconds(replayed: Replay) -> float:
    return (replayed.frames[-1].stamp - replayed.frames[0].stamp) / 1e9
