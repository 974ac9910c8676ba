# SPDX-License-Identifier: Apache-2.0
"""`paul view`: the excerpt of a bag, the drawings, and the film files."""

from __future__ import annotations

import os
import stat
import sys

import numpy as np
import pytest
from conftest import PERSON, camera_info, header_of, persons_at, seen
from PIL import Image

from msg_adapters import outputs
from msg_adapters.palette import SIDE_COLOURS
from paul_ros import cli
from paul_ros.errors import BagError, PictureError
from paul_ros.model_file import load_model
from paul_ros.offline import film, film_excerpt, film_model, film_stage
from paul_ros.offline.bag_reader import read_records
from paul_ros.offline.bag_records import BagMessages
from paul_ros.offline.bag_writer import BagWriter
from paul_ros.offline.canvas import AMBER, turntable
from paul_ros.offline.film_files import write_film
from paul_ros.offline.replay import replay
from paul_ros.offline.shipped_bags import find_bag
from paul_ros.stream.stream import open_stream

MAKE = BagMessages()


def make_bag(path, frames: int, rate: float = 30.0, persons=lambda index: persons_at((0.3, 0, 4)), camera: bool = True):
    """A bag of persons in metres under the tests' camera."""
    with BagWriter(path) as writer:
        for index in range(frames):
            time = 10**9 + int(index / rate * 1e9)
            header = header_of(MAKE, time // 10**9, time % 10**9)
            if camera:
                writer.write("/camera_info", camera_info(MAKE), time)
            xy = seen(persons(index))
            msg = outputs.keypoints_cloud(MAKE, header, xy, np.ones(xy.shape[:2]), [str(i) for i in range(len(xy))])
            writer.write("/keypoints", msg, time)
    return path


@pytest.fixture
def drawn(monkeypatch):
    """The pictures that would have been written."""
    pictures: list = []
    for module in (film, film_model):
        monkeypatch.setattr(module, "write_film", lambda path, made: pictures.extend(made))
    return pictures


def has(picture: np.ndarray, colour: str) -> int:
    """How many pixels are of about a colour."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(picture.astype(int) - rgb).max(axis=2) < 12).sum())


LEFT, RIGHT = (SIDE_COLOURS[side] for side in ("left", "right"))


def test_a_bag_as_gif(tmp_path, model_file, capsys):
    bag, out = make_bag(tmp_path / "walk.mcap", 31), tmp_path / "film.gif"
    assert cli.main(["view", str(bag), "-o", str(out), "--model", str(model_file)]) == 0
    written = Image.open(out)
    assert (written.format, written.n_frames, written.size) == ("GIF", 11, (900, 500))
    assert written.info["duration"] == 100
    printed = capsys.readouterr().out
    assert printed == f"{out}: 11 pictures of 31 messages, 0.0 to 1.0 s of 1.0 s, in real time\n"
    # The palette has the drawing's colours.
    assert has(np.asarray(written.convert("RGB")), LEFT) > 50 and has(np.asarray(written.convert("RGB")), RIGHT) > 50


def test_a_model_as_png(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["view", "human", "-o", "model.png"]) == 0
    picture = np.asarray(Image.open("model.png"))
    assert picture.shape == (4 * 500, 900, 3)
    assert "mean shape and 3 modes of its 16 codes" in capsys.readouterr().out


def test_the_name_of_the_film_is_the_bags(tmp_path, model_file, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bag = make_bag(tmp_path / "walk.mcap", 2)
    assert cli.main(["view", str(bag), "--model", str(model_file)]) == 0
    assert (tmp_path / "walk.gif").exists()


def test_a_long_bag_is_shown_in_larger_steps(tmp_path, model_file, drawn, monkeypatch):
    monkeypatch.setattr(film_excerpt, "MAX_PICTURES", 5)
    bag = make_bag(tmp_path / "long.mcap", 61)
    drawn_film, _ = film.view_bag(bag, open_stream(str(model_file)), tmp_path / "f.gif")
    assert drawn_film.pictures == len(drawn) == 5
    assert drawn_film.summary == "5 pictures of 61 messages, 0.0 to 2.0 s of 2.0 s, 5.0 times as fast as real time"


def test_a_part_of_a_bag(tmp_path, model_file, drawn):
    bag, stream = make_bag(tmp_path / "long.mcap", 61), open_stream(str(model_file))
    drawn_film, _ = film.view_bag(bag, stream, tmp_path / "f.gif", start=1.0, seconds=0.5)
    assert len(drawn) == 6 and "1.0 to 1.5 s of 2.0 s" in drawn_film.summary
    assert stream.counts["frames"] == 6


def test_no_keypoints_then(tmp_path, model_file):
    bag = make_bag(tmp_path / "short.mcap", 3)
    with pytest.raises(BagError, match="from 9 s on; the bag has keypoints up to 0.1 s: choose an earlier --start"):
        film.view_bag(bag, open_stream(str(model_file)), tmp_path / "f.gif", start=9.0)
    with pytest.raises(BagError, match="from 0.01 s to 0.02 s; the next are at 0.033 s: choose larger --seconds"):
        film.view_bag(bag, open_stream(str(model_file)), tmp_path / "f.gif", start=0.01, seconds=0.01)


def test_frames_without_metres_are_not_drawn_among_metres(tmp_path, model_file, drawn, capsys):
    """The first CameraInfo comes after a second: in model units a person would stand in the camera."""
    whole, late = make_bag(tmp_path / "whole.mcap", 61), tmp_path / "late.mcap"
    with BagWriter(late) as writer:
        for record in read_records(whole):
            if record.topic != "/camera_info" or record.log_time >= 2 * 10**9:
                writer.write_record(record)
    assert cli.main(["view", str(late), "-o", str(tmp_path / "f.gif"), "--model", str(model_file)]) == 0
    assert len(drawn) == 11
    assert capsys.readouterr().out.endswith(", 10 frames without metres left out\n")


def test_a_camera_after_the_last_frame_makes_no_metres(tmp_path, model_file):
    """Persons in model units have no place in a room."""
    bag = make_bag(tmp_path / "x.mcap", 10, camera=False)
    stream = open_stream(model_file)
    done = replay(bag, stream)
    stream.camera_info(camera_info(MAKE))
    assert done.stream.units == "m" and {frame.lifted.units for frame in done.frames} == {"model"}
    assert film_stage.Stage.of(done, "x", 0.0).room is None


def test_no_keypoints_at_all(tmp_path, model_file, capsys):
    bag = make_bag(tmp_path / "short.mcap", 3)
    assert cli.main(["view", str(bag), "--topic", "/others", "-o", str(tmp_path / "f.gif")]) == 1
    assert "no messages on /others; the topics with a type for keypoints are /keypoints" in capsys.readouterr().err


def test_nobody_lifted(tmp_path, model_file):
    bag = make_bag(tmp_path / "empty.mcap", 3, persons=lambda index: np.empty((0, 17, 3)))
    with pytest.raises(PictureError, match="nobody was lifted"):
        film.view_bag(bag, open_stream(str(model_file)), tmp_path / "f.gif")


def test_half_a_bag_is_drawn_and_reported(tmp_path, capsys):
    whole = find_bag("one_person").read_bytes()
    bag, out = tmp_path / "half.mcap", tmp_path / "f.png"
    bag.write_bytes(whole[: len(whole) // 8])
    assert cli.main(["view", str(bag), "-o", str(out)]) == 1
    assert out.exists()
    printed = capsys.readouterr()
    assert "4 pictures" in printed.out and printed.err.startswith("paul: ")


def test_what_was_not_seen_is_pale(tmp_path, model_file, drawn):
    def half_hidden(index):
        body = persons_at((0.3, 0, 4))
        if index:
            body[:, [i for i, name in enumerate(load_model(model_file).layout.names) if "left" in name]] = np.nan
        return body

    bag = make_bag(tmp_path / "hidden.mcap", 4, rate=10, persons=half_hidden)
    film.view_bag(bag, open_stream(str(model_file)), tmp_path / "f.gif")
    turntables = [picture[100:440, 420:] for picture in drawn]
    assert has(turntables[0], LEFT) > 200 > 20 > has(turntables[1], LEFT)
    assert has(turntables[1], RIGHT) > 200


def test_doubt_is_amber(tmp_path, model_file, drawn, monkeypatch):
    bag, stream = make_bag(tmp_path / "one.mcap", 1), open_stream(str(model_file))
    monkeypatch.setattr(film_stage, "AMBIGUOUS", 2.0)
    film.view_bag(bag, stream, tmp_path / "f.gif")
    monkeypatch.setattr(film_stage, "AMBIGUOUS", 0.0)
    film.view_bag(bag, stream, tmp_path / "f.gif")
    sure, doubtful = drawn
    assert has(sure, AMBER) == 0
    assert has(doubtful[:30], AMBER) > 10_000 and has(doubtful[60:], AMBER) > 200


def test_without_a_camera(tmp_path, model_file, drawn):
    bag = make_bag(tmp_path / "pixels.mcap", 2, rate=10, camera=False)
    film.view_bag(bag, open_stream(str(model_file)), tmp_path / "f.gif")
    assert len(drawn) == 2 and has(drawn[0], LEFT) > 200


def test_without_a_camera_and_nobody_at_first(tmp_path, drawn):
    """The layout of the input shows with the first person; the images before have the points of the model."""
    bag = make_bag(
        tmp_path / "late.mcap",
        2,
        rate=10,
        persons=lambda index: persons_at((0.3, 0, 4)) if index else np.empty((0, 17, 3)),
        camera=False,
    )
    film.view_bag(bag, open_stream(), tmp_path / "f.gif")
    assert len(drawn) == 2 and not has(drawn[0][35:400], LEFT) and has(drawn[1], LEFT) > 200


def test_the_turntable_shows_whole_persons_and_the_ground(tmp_path, model_file):
    """Of one that moves fast as well; and all pictures have squares of one size."""
    height = [0, 0, -1.5, -0.5, 0, 0, 3, 0, 0, 0]
    bag = make_bag(tmp_path / "jump.mcap", 10, rate=10, persons=lambda index: persons_at((0.3, height[index], 6)))
    stage = film_stage.Stage.of(replay(bag, open_stream(str(model_file))), "jump", 0.0)
    for index, frame in enumerate(stage.done.frames):
        points = (frame.lifted.points[frame.lifted.ok] - stage.centres[index]) @ turntable(film_stage._TURN * index).T
        assert np.abs(points[..., :2]).max() < stage.radii[index]
        assert 0 < stage.depths[index] < stage.radii[index]
    assert stage.spacing == film_stage._grid_spacing(np.median(stage.radii))


def test_the_turntable():
    np.testing.assert_allclose(turntable(0.3) @ turntable(0.3).T, np.eye(3), atol=1e-12)
    up = turntable(1.0) @ np.array([0, -1.0, 0])
    assert up[1] < -0.9 and abs(up[0]) < 1e-12
    # A viewer who looks down sees farther points higher in the picture.
    assert (turntable(0.0) @ np.array([0, 0, 1.0]))[1] * -1 > 0.1
    # A quarter turn brings the right to where the far side was.
    np.testing.assert_allclose(np.abs((turntable(np.pi / 2) @ np.array([1.0, 0, 0]))[0]), 0, atol=1e-12)


def test_a_model_is_seen_from_the_front(model_file):
    model = load_model(model_file)
    shape = film_model._front_view(model) @ model.mean_shape
    at = dict(zip(model.layout.names, shape.T))
    assert at["nose"][1] < at["left_hip"][1] < at["left_ankle"][1]
    assert at["left_shoulder"][0] > at["right_shoulder"][0]
    assert at["nose"][2] < at["left_ear"][2]
    assert np.linalg.det(film_model._front_view(model)) == pytest.approx(1)


def test_modes_of_codes():
    mean, modes, shares = film_model.code_modes(load_model())
    assert mean.shape == (16,) and modes.shape == (3, 16)
    np.testing.assert_allclose((modes @ modes.T)[~np.eye(3, dtype=bool)], 0, atol=1e-9)
    assert (np.diff(shares) < 0).all() and 0 < shares.sum() <= 1


def test_a_model_whose_codes_never_change(model_file, drawn, tmp_path):
    """All its weights are zero: there is the mean shape alone."""
    drawn_film = film_model.view_model(load_model(model_file), tmp_path / "f.png")
    assert drawn_film.summary.startswith("the mean shape and 0 modes") and has(drawn[0], LEFT) > 100


def test_persons_in_messages_of_their_own_come_together():
    times = np.array([0, 2, 33, 35, 66, 68]) * 1_000_000
    chosen = film_excerpt._with_same_image(times, times[[0, 4]])
    assert chosen.tolist() == times[[0, 1, 4, 5]].tolist()


@pytest.mark.parametrize("radius, spacing", [(1.0, 0.5), (0.4, 0.1), (3.9, 1.0), (30.0, 10.0), (0.004, 0.001)])
def test_grid(radius, spacing):
    assert film_stage._grid_spacing(radius) == pytest.approx(spacing)


def test_other_formats_are_refused(tmp_path, capsys):
    assert cli.main(["view", "human", "-o", str(tmp_path / "film.avi")]) == 1
    assert "a film is a file that ends in .gif or .mp4 or .png" in capsys.readouterr().err


def test_mp4_without_ffmpeg(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert cli.main(["view", "human", "-o", str(tmp_path / "film.mp4")]) == 1
    assert "ffmpeg, which is missing; choose a name ending in .gif" in capsys.readouterr().err


@pytest.mark.parametrize("fails", [False, True])
def test_mp4_by_ffmpeg(tmp_path, monkeypatch, fails):
    """A stand-in that keeps what it is sent, under the name of its last argument."""
    program = tmp_path / "ffmpeg"
    keep = "import sys; open(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())"
    command = "echo no codec >&2; exit 3" if fails else f'exec {sys.executable} -c "{keep}" "$@"'
    program.write_text(f"#!/bin/sh\n{command}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    pictures = [np.full((4, 6, 3), shade, np.uint8) for shade in (1, 2, 3)]
    out = tmp_path / "films" / "film.mp4"
    if fails:
        with pytest.raises(PictureError, match="ffmpeg failed: no codec"):
            write_film(out, iter(pictures))
        assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]
    else:
        write_film(out, iter(pictures))
        assert out.read_bytes() == b"".join(picture.tobytes() for picture in pictures)
        assert [path.name for path in out.parent.iterdir()] == ["film.mp4"]


def test_without_matplotlib(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert cli.main(["view", "human", "-o", str(tmp_path / "film.png")]) == 1
    assert "'matplotlib' is missing: pip install '.[bags]' in a clone of paul_ros" in capsys.readouterr().err


def test_the_bag_is_never_overwritten(tmp_path, capsys):
    bag = make_bag(tmp_path / "walk.mcap", 2)
    before = bag.read_bytes()
    assert cli.main(["view", str(bag), "-o", str(bag)]) == 1
    assert bag.read_bytes() == before and capsys.readouterr().err


@pytest.mark.parametrize("words", [["--start", "-1"], ["--seconds", "long"], ["--start", "nan"]])
def test_odd_times_are_refused(words, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["view", "walk.mcap", *words])
    assert end.value.code == 2 and "number of seconds" in capsys.readouterr().err


def test_an_equal_bag_gives_an_equal_film(tmp_path, model_file):
    bag = make_bag(tmp_path / "walk.mcap", 4, rate=10)
    for name in ("a.gif", "b.gif"):
        film.view_bag(bag, open_stream(str(model_file)), tmp_path / name)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_lifted_points_fall_on_the_input(tmp_path, model_file):
    from paul_ros.offline.replay import replay

    done = replay(make_bag(tmp_path / "walk.mcap", 1), open_stream(str(model_file)))
    frame = done.frames[0]
    np.testing.assert_allclose(film_stage._reprojected(frame), frame.keypoints.xy, atol=0.5)
    assert PERSON.shape == frame.lifted.points[0].shape
