# SPDX-License-Identifier: Apache-2.0
"""Several files in one training: recordings of one layout in a row, categories of objects side by side."""

import argparse

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_data import FROM_RANDOM_WEIGHTS

from paul_ros.cli import train as cli
from paul_ros.layout import Layout, anonymous_layout, load_layout
from paul_ros.lifted import TOO_FEW_POINTS
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from training.categories import joint_layout, load_files
from training.errors import DataError
from training.judge.evaluation import evaluate_model
from training.judge.truth import load_sequence
from training.networks import build_networks
from training.objective import own_points, paul_terms
from training.recipe import Recipe
from training.views import NormalisedViews

SMALL = [word for item in ("steps=8", "width=16", "batch=8", "bottleneck=3") for word in ("--set", item)]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


def write(path, points, frames=20, seed=0, **more):
    """Write turned views of one random body."""
    rng = np.random.default_rng(seed)
    S = Rotation.random(frames, random_state=seed).as_matrix() @ rng.standard_normal((3, points))
    np.savez(path, W=(100 * S[:, :2] + 300).astype(np.float32), **more)
    return path


def train(*arguments):
    parser = argparse.ArgumentParser()
    cli.add_arguments(parser)
    return cli.run(
        parser.parse_args([str(argument) for argument in (*FROM_RANDOM_WEIGHTS, *arguments, *SMALL, "--quiet")])
    )


@pytest.fixture
def garage(tmp_path):
    """A category of 7 points among 90: 30 % of all points are more than it has."""
    return [
        write(tmp_path / "car.npz", 7, seed=1, edges=np.array([[0, 6]])),
        write(tmp_path / "bus.npz", 83, frames=5, seed=2, edges=np.array([[1, 2], [81, 82]])),
    ]


def test_categories_lie_side_by_side(garage):
    data = load_files(garage)
    assert data.W.shape == (25, 2, 90) and data.left_out == 0
    assert data.visible[:20, :7].all() and not data.visible[:20, 7:].any()
    assert data.visible[20:, 7:].all() and not data.visible[20:, :7].any()
    for rows, points, path in ((slice(20), slice(7), garage[0]), (slice(20, None), slice(7, None), garage[1])):
        np.testing.assert_array_equal(data.W[rows, :, points], np.load(path)["W"])
    assert data.layout.names[:8] == (*(f"car.p{i:02}" for i in range(7)), "bus.p00")
    assert data.layout.edges == ((0, 6), (8, 9), (88, 89))
    assert data.source == "car.npz, bus.npz" and data.notes == ()


@settings(deadline=None, max_examples=30)
@given(st.lists(st.integers(3, 30), min_size=1, max_size=5), st.data())
def test_joint_layouts_keep_what_their_parts_say(sizes, data):
    layouts = []
    for points in sizes:
        pairs = st.tuples(st.integers(0, points - 1), st.integers(0, points - 1)).filter(
            lambda pair: pair[0] != pair[1]
        )
        edges = data.draw(st.lists(pairs, max_size=4))
        layouts.append(anonymous_layout(points, tuple(edges)))
    names = [f"c{i}" for i in range(len(sizes))]
    joint = joint_layout(names, layouts)
    first = 0
    edges = iter(joint.edges)
    for name, layout in zip(names, layouts):
        assert joint.categories[name] == tuple(range(first, first + len(layout.names)))
        for edge in layout.edges:
            assert next(edges) == (edge[0] + first, edge[1] + first)
        first += len(layout.names)
    assert Layout.from_dict(joint.to_dict()) == joint


def test_sides_and_rules_go_with_their_category(tmp_path):
    person = write(tmp_path / "person.npz", 17)
    data = load_files([write(tmp_path / "box.npz", 4, seed=3), person])
    coco = load_layout("coco17")
    assert data.layout.left_right == tuple((a + 4, b + 4) for a, b in coco.left_right)
    assert data.layout.handedness[0].left == tuple(point + 4 for point in coco.handedness[0].left)


def test_recordings_of_one_layout_follow_each_other(tmp_path):
    paths = [write(tmp_path / f"{i}.npz", 5, seed=i) for i in range(2)]
    data = load_files(paths, anonymous_layout(5))
    assert data.W.shape == (40, 2, 5) and not data.layout.categories
    np.testing.assert_array_equal(data.W[20:], np.load(paths[1])["W"])
    people = load_files([write(tmp_path / f"person{i}.npz", 17, seed=i) for i in range(2)])
    assert people.W.shape == (40, 2, 17) and people.layout.name == "coco17"
    apart = load_files(paths)  # of unknown points, they may be different things
    assert (
        len(apart.layout.names) == 10 and "recordings of one object are joined with --layout points5" in apart.notes[-1]
    )


def test_files_that_do_not_go_together_are_refused(tmp_path):
    pixels = write(tmp_path / "a.npz", 5)
    W = (np.load(pixels)["W"] - 300) / 1000
    np.savez(tmp_path / "rays.npz", W=W, calibrated=True)
    with pytest.raises(DataError, match="rays"):
        load_files([pixels, tmp_path / "rays.npz"])
    (tmp_path / "more").mkdir()
    with pytest.raises(DataError, match="a is there twice.*--layout"):
        load_files([pixels, write(tmp_path / "more" / "a.npz", 6)])


@pytest.mark.parametrize("scale", ["free", "unit"])
def test_points_of_other_categories_cost_nothing(garage, scale):
    """Points of the bus may be anywhere in a frame of the car, in both streams; the car's own points may not."""
    data = load_files(garage)
    recipe = Recipe.from_dict({"bottleneck": 3, "hidden": [8], "width": 8, "scale": scale})
    torch.manual_seed(0)
    networks = build_networks(data.layout, recipe, 25)
    W, visible = torch.from_numpy(data.W[:20]), torch.from_numpy(data.visible[:20]).clone()
    visible[:, 6] = False
    views = NormalisedViews.of(W, visible, torch.ones(20, 1, 1), False, data.image_unit if scale == "unit" else None)
    weights = networks.decoder[-1].weight.data.view(3, 90, -1)
    networks.shape_encoder[0].weight.data.view(-1, 3, 90)[:, :, 7:] = 0  # else f_e passes every point to one stream

    def losses():
        with torch.no_grad():
            terms = paul_terms(networks, data.layout, recipe, views, torch.arange(20))
        return terms.recon_ad.item(), terms.recon_ae.item()

    before = losses()
    weights[:, 40] *= 20
    assert losses() == pytest.approx(before, rel=1e-4)
    for own in (6, 3):
        weights[:, own] *= 20
        assert losses() != pytest.approx(before, rel=1e-2)
        before = losses()


def test_own_points_are_those_of_the_category_that_is_seen(garage):
    layout = load_files(garage).layout
    visible = torch.zeros(3, 90, dtype=torch.bool)
    visible[0, 2:6] = visible[1, 50:80] = visible[2, 5:12] = True  # the last: two of the car, five of the bus
    own = own_points(visible, layout)
    assert own[0].tolist() == [1] * 7 + [0] * 83 and own[1].tolist() == own[2].tolist() == [0] * 7 + [1] * 83
    assert own_points(visible, anonymous_layout(90)) is None


def test_a_model_of_several_categories_trains_and_lifts_each(garage, tmp_path):
    train(*garage, "-o", tmp_path / "m.npz")
    model = load_model(tmp_path / "m.npz")
    assert model.layout.categories.keys() == {"car", "bus"} and model.min_visible == 4
    xy, visible = np.full((3, 90, 2), np.nan), np.zeros((3, 90), bool)
    xy[0, :7], visible[0, :7] = np.load(garage[0])["W"][0].T, True
    xy[1, 7:], visible[1, 7:] = np.load(garage[1])["W"][0].T, True
    xy[2, 7:11], visible[2, 7:11] = np.load(garage[1])["W"][0].T[:4], True
    lifted = Lifter(model).lift(xy, visible)
    assert lifted.reason == ("", "", TOO_FEW_POINTS)


def test_data_without_a_layout_just_trains(tmp_path):
    train(write(tmp_path / "thing.npz", 41), "-o", tmp_path / "m.npz")
    layout = load_model(tmp_path / "m.npz").layout
    assert layout.name == "points41" and layout.names[0] == "p00"
    with pytest.raises(DataError, match="points41.*--layout"):
        train(write(tmp_path / "other.npz", 40), "-o", tmp_path / "o.npz", "--layout", "points41")


def test_a_category_is_judged_by_its_own_points(garage, tmp_path):
    train(*garage, "-o", tmp_path / "m.npz")
    with np.load(garage[0]) as archive:
        W = archive["W"].astype(float)
    S = np.concatenate([W, W[:, :1]], axis=1)
    np.savez(garage[0], W=W, S=S)
    truth = load_sequence(garage[0]).among_categories(load_model(tmp_path / "m.npz").layout)
    assert truth.present.tolist() == truth.visible.tolist() == load_files(garage).visible[:20].tolist()
    np.testing.assert_array_equal(truth.S[:, :, :7], S)
    report, compared = evaluate_model(tmp_path / "m.npz", garage[0])
    assert report["frames"] == 20 and report["hidden_share"] == 0 and np.isfinite(report["ne_flip_frame_percent"])
    np.savez(tmp_path / "van.npz", W=W, S=S)
    with pytest.raises(DataError, match="7 points.*90"):
        evaluate_model(tmp_path / "m.npz", tmp_path / "van.npz")
