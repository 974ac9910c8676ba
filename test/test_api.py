# SPDX-License-Identifier: Apache-2.0
"""The public Python API: its names, its examples, every kind of argument of Lifter.lift, and advice on wrong ones."""

from __future__ import annotations

import doctest
import importlib
import subprocess
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import CENTRE, FOCAL, camera_info, persons_at, seen

import paul_ros
from paul_ros import Intrinsics, Layout, Lifted, Lifter, Model, OnP, PaulError, load_layout, load_model, onp
from paul_ros.lifted import TOO_FEW_POINTS

ROOT = Path(__file__).resolve().parent.parent
K = [[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]]
CAMERA = Intrinsics(FOCAL, FOCAL, *CENTRE, 640, 480)
POINTS = seen(persons_at((0.3, 0, 4), (-0.6, 0, 5)))
#: Modules whose docstrings have examples.
WITH_EXAMPLES = [
    "msg_adapters.palette",
    "paul_ros",
    "paul_ros.body_axes",
    "paul_ros.layout",
    "paul_ros.lifted",
    "paul_ros.lifter",
    "paul_ros.metrics",
    "paul_ros.model",
    "paul_ros.orthographic_n_point",
]
WITHOUT_EXAMPLES = [
    "paul_ros.arithmetic",
    "paul_ros.errors",
    "paul_ros.extras",
    "paul_ros.files",
    "paul_ros.layout_schema",
    "paul_ros.lift_arguments",
    "paul_ros.model_file",
    "paul_ros.normalisation",
    "paul_ros.output_files",
    "paul_ros.pinhole_pose",
    "paul_ros.placeholders",
    "paul_ros.placement",
    "paul_ros.route",
    "paul_ros.signals",
    "paul_ros.shape_fit",
    "paul_ros.versions",
    "paul_ros.viewing_goal",
    "paul_ros.viewing_sphere",
    "paul_ros.wording",
]


@pytest.fixture(scope="module")
def lifter() -> Lifter:
    return Lifter("human")


def assert_equal(one: Lifted, other: Lifted) -> None:
    for name, value in vars(one).items():
        np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


# --- names


def test_every_public_name_is_what_it_says() -> None:
    kinds = {name: getattr(paul_ros, name) for name in paul_ros.__all__}
    assert kinds == {
        "Intrinsics": Intrinsics,
        "Layout": Layout,
        "Lifted": Lifted,
        "Lifter": Lifter,
        "Model": Model,
        "OnP": OnP,
        "PaulError": PaulError,
        "load_layout": load_layout,
        "load_model": load_model,
        "onp": onp,
    }
    assert set(paul_ros.__all__) <= set(dir(paul_ros)) and "__version__" in dir(paul_ros)
    assert paul_ros._HOMES.keys() == set(paul_ros.__all__)
    assert isinstance(onp(np.ones((1, 3, 4)), np.ones((1, 2, 4))), OnP)


def test_an_unknown_name_is_no_attribute() -> None:
    assert not hasattr(paul_ros, "Liftr")
    with pytest.raises(ImportError, match="Liftr"):
        exec("from paul_ros import Liftr")


def test_the_package_alone_imports_nothing_but_the_name_asked_for() -> None:
    """The node sets the number of threads before numpy is imported, and `paul --help` is quick."""
    code = """
import sys
import paul_ros
assert not {"numpy", "yaml", "paul_ros.layout"} & set(sys.modules)
from paul_ros import PaulError
assert "numpy" not in sys.modules
from paul_ros import *
assert Lifter.__module__ == "paul_ros.lifter" and "numpy" in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, timeout=60)


def test_the_lists_of_modules_are_complete() -> None:
    core = {f"paul_ros.{path.stem}" for path in (ROOT / "paul_ros").glob("[a-z]*.py")}
    assert core <= {*WITH_EXAMPLES, *WITHOUT_EXAMPLES}


@pytest.mark.parametrize("module", [*WITH_EXAMPLES, *WITHOUT_EXAMPLES])
def test_examples_in_docstrings_run(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.failed == 0
    assert bool(result.attempted) == (module in WITH_EXAMPLES)


# --- models, cameras, layouts, visibility


def test_a_model_comes_by_name_by_path_or_as_itself(lifter: Lifter, model_file: Path) -> None:
    assert_equal(Lifter(load_model("human")).lift(POINTS, layout="coco17"), lifter.lift(POINTS, layout="coco17"))
    by_path, by_text, itself = Lifter(model_file), Lifter(str(model_file)), Lifter(load_model(model_file))
    assert by_path.model.sha256 == by_text.model.sha256 == itself.model.sha256
    with pytest.raises(PaulError, match="did you mean 'human'"):
        Lifter("humna")
    with pytest.raises(PaulError, match="model is a int: pass a name"):
        Lifter(17)


def test_three_kinds_of_camera_give_equal_results(lifter: Lifter, make) -> None:
    lifted = lifter.lift(POINTS, camera=CAMERA, layout="coco17")
    assert lifted.ok.all() and lifted.units == "m"
    np.testing.assert_allclose(lifted.root, [[0.3, 0.1, 4], [-0.6, 0.1, 5]], atol=0.5)
    for camera in (K, np.array(K), np.array(K, np.float32), camera_info(make)):
        assert_equal(lifter.lift(POINTS, camera=camera, layout="coco17"), lifted)
    assert lifter.lift(POINTS, layout="coco17").units == "model"


def test_a_layout_comes_by_name_by_path_or_as_itself(lifter: Lifter, tmp_path: Path) -> None:
    coco = load_layout("coco17")
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(coco.to_dict()))
    by_name = lifter.lift(POINTS, camera=CAMERA, layout="coco17")
    assert by_name.layout == coco and by_name.points.shape == (2, 17, 3) and by_name.used.shape == (2, 17)
    for layout in (coco, tmp_path / "mine.yaml", str(tmp_path / "mine.yaml")):
        assert_equal(lifter.lift(POINTS, camera=CAMERA, layout=layout), by_name)


def test_points_come_back_in_the_layout_that_they_came_in(lifter: Lifter) -> None:
    """As the same points in the model's own layout, picked by name; a derived point is the mean of its parts."""
    human, coco = lifter.model.layout, load_layout("coco17")
    into = coco.map_to(human)
    xy, _, visible = into(POINTS, np.ones((2, 17)), np.ones((2, 17), bool))
    own = lifter.lift(xy, visible, CAMERA)
    assert own.layout == human and own.points.shape == (2, 43, 3)
    lifted = lifter.lift(POINTS, camera=CAMERA, layout="coco17")
    order = [human.names.index(name) for name in coco.names]
    np.testing.assert_array_equal(lifted.points, own.points[:, order])
    np.testing.assert_array_equal(lifted.used, own.used[:, order])
    np.testing.assert_array_equal(lifted.root, own.root)


def test_points_of_a_layout_that_the_model_cannot_complete_come_back_in_the_models(lifter: Lifter) -> None:
    cmu = load_layout("cmu31")
    xy = np.random.default_rng(0).normal(320, 60, (1, 31, 2))
    lifted = lifter.lift(xy, layout=cmu)
    assert lifted.layout == lifter.model.layout and lifted.points.shape == (1, 43, 3)


def test_todays_call_is_that_of_the_stream(lifter: Lifter) -> None:
    xy = np.random.default_rng(0).normal(320, 60, (3, 43, 2))
    visible = np.random.default_rng(1).random((3, 43)) < 0.6
    assert_equal(lifter.lift(xy, visible, CAMERA), lifter.lift_in_model_layout(xy, visible, CAMERA))


def test_one_person_needs_no_first_axis_and_comes_back_with_one(lifter: Lifter) -> None:
    visible = np.arange(17) != 3
    one = lifter.lift(POINTS[0], visible, CAMERA, "coco17")
    assert_equal(one, lifter.lift(POINTS[:1], visible[None], CAMERA, "coco17"))
    assert one.points.shape == (1, 17, 3)
    assert_equal(lifter.lift(POINTS[0].tolist(), visible.tolist(), K, "coco17"), one)


def test_points_without_visibility_are_visible_where_they_are_finite(lifter: Lifter) -> None:
    xy, visible = POINTS.copy(), np.ones((2, 17), bool)
    xy[0, 2, 0], xy[1, 5, 1] = np.nan, np.inf
    visible[0, 2] = visible[1, 5] = False
    lifted = lifter.lift(xy, camera=K, layout="coco17")
    assert_equal(lifted, lifter.lift(xy, visible, K, "coco17"))
    assert_equal(lifted, lifter.lift(xy, visible.astype(int), K, "coco17"))
    assert not lifted.used[0, 2] and not lifted.used[1, 5]
    assert_equal(lifter.lift(xy, np.ones((2, 17), bool), K, "coco17"), lifted)


def test_a_person_that_cannot_be_lifted_is_nan_with_a_reason(lifter: Lifter) -> None:
    visible = np.ones((2, 17), bool)
    visible[0, 3:] = False
    lifted = lifter.lift(POINTS, visible, K, "coco17")
    assert lifted.reason == (TOO_FEW_POINTS, "") and np.isnan(lifted.points[0]).all() and lifted.layout.name == "coco17"


# --- wrong arguments


def _camera(**changes: object) -> types.SimpleNamespace:
    info = {"p": [0.0] * 12, "k": [FOCAL, 0, 320, 0, FOCAL, 240, 0, 0, 1], "d": [], "width": 640, "height": 480}
    info |= {"distortion_model": "", "binning_x": 0, "binning_y": 0}
    info["roi"] = types.SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    return types.SimpleNamespace(**{**info, **changes})


@pytest.mark.parametrize("height", [-1.7, float("nan"), float("inf"), "tall"])
def test_a_height_that_nobody_has_is_refused(height: object) -> None:
    with pytest.raises(PaulError, match="person_height is .*: pass metres"):
        Lifter("human", person_height=height)


def test_a_layout_is_asked_for_by_name_or_path() -> None:
    with pytest.raises(PaulError, match="layout is a int: pass a name"):
        load_layout(17)


@pytest.mark.parametrize(
    "arguments, advice",
    [
        ({"points": POINTS}, r"\(2, 17, 2\), layout 'human' needs \(N,43,2\).*layout='coco17'.*coco17, h36m17"),
        ({"points": POINTS[0]}, r"shape \(17, 2\).* or \(43,2\) for one person.*layout='coco17'"),
        (
            {"points": POINTS[:, :16], "layout": "coco17"},
            r"\(2, 16, 2\), layout 'coco17' needs \(N,17,2\), or \(17,2\)",
        ),
        ({"points": np.ones((1, 43, 3))}, r"points\[..., :2\], and confidences as visible=points\[..., 2\] > 0.3"),
        ({"points": np.ones((1, 2, 43))}, "transpose"),
        ({"points": np.ones(86)}, r"shape \(86,\)"),
        ({"points": "points.npz"}, "points of type str cannot be an array"),
        ({"points": [[[1, 2]], [[1, 2], [3, 4]]]}, "points of type list cannot be an array"),
        ({"points": POINTS, "layout": "coco"}, "did you mean 'coco17'"),
        ({"points": POINTS, "layout": 17}, "layout is a int: pass a name"),
        ({"points": np.ones((1, 4, 2)), "layout": "points4"}, "at least 3 are needed"),
        ({"visible": np.ones((1, 17), bool)}, r"visible has shape \(1, 17\), points \(2, 17, 2\) need \(2, 17\)"),
        ({"visible": np.full((2, 17), 0.7)}, "compare confidences with a threshold"),
        ({"visible": np.full((2, 17), "yes")}, "visible must be true or false"),
        ({"camera": np.eye(3)}, "focal lengths from 10 to 1e.06 pixels.*not normalised"),
        ({"camera": [[600, 3, 320], [0, 600, 240], [0, 0, 1]]}, "without skew"),
        ({"camera": [[600, 0, 320], [0, 600, 240], [0, 0, 2]]}, "no camera matrix"),
        ({"camera": [[600, 0, np.nan], [0, 600, 240], [0, 0, 1]]}, "no camera matrix"),
        ({"camera": np.ones((3, 4))}, r"shape \(3, 4\): pass Intrinsics, a 3x3 camera matrix K"),
        ({"camera": FOCAL}, r"shape \(\): pass Intrinsics"),
        ({"camera": Intrinsics(-1.0, 600.0, 320.0, 240.0, 640, 480)}, "fx -1.0.*focal lengths of 10 to 1e.06"),
        ({"camera": Intrinsics(600.0, np.nan, 320.0, 240.0, 640, 480)}, "fy nan"),
        ({"camera": Intrinsics(600.0, 600.0, np.inf, 240.0, 640, 480)}, "cx inf"),
        ({"camera": Intrinsics(600.0, 600.0, 1e9, 240.0, 640, 480)}, "a principal point within 1e.06"),
        ({"camera": Intrinsics("600", 600.0, 320.0, 240.0, 640, 480)}, "fx '600'"),
        ({"camera": "camera.yaml"}, "camera of type str cannot be an array"),
        ({"camera": _camera(k=[0.0] * 9)}, "calibrate the camera"),
        ({"camera": _camera(p=[0.0])}, "no sensor_msgs/CameraInfo"),
        ({"visible": [[True] * 17, [True]]}, "visible cannot be an array"),
        (
            {"points": POINTS[0], "layout": "coco17", "visible": np.ones((1, 17), bool)},
            r"visible has shape \(1, 17\), points \(17, 2\) need \(17,\)",
        ),
    ],
)
def test_wrong_arguments_are_refused_with_advice(lifter: Lifter, arguments: dict, advice: str) -> None:
    given = {"points": POINTS, "layout": None if "points" in arguments else "coco17", **arguments}
    with pytest.raises(PaulError, match=advice) as refusal:
        lifter.lift(**given)
    assert isinstance(refusal.value, ValueError) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("placeholder", [0.0, -1.0])
def test_placeholders_are_hidden_unless_visible_says_otherwise(lifter: Lifter, placeholder: float) -> None:
    marked, hidden = POINTS.copy(), POINTS.copy()
    marked[0, 5:8], hidden[0, 5:8] = placeholder, np.nan
    assert_equal(lifter.lift(marked, camera=K, layout="coco17"), lifter.lift(hidden, camera=K, layout="coco17"))
    every = np.ones(POINTS.shape[:2], bool)
    seen = lifter.lift(marked, every, K, "coco17")
    assert not np.array_equal(seen.points, lifter.lift(marked, camera=K, layout="coco17").points)


def test_masked_values_are_hidden(lifter: Lifter) -> None:
    mask = np.zeros(POINTS.shape, bool)
    mask[0, 5:8] = True
    hidden = np.where(mask, np.nan, POINTS)
    masked = np.ma.masked_array(POINTS, mask)
    assert_equal(lifter.lift(masked, camera=K, layout="coco17"), lifter.lift(hidden, camera=K, layout="coco17"))


def test_normalised_points_are_warned_of(lifter: Lifter) -> None:
    with pytest.warns(UserWarning, match="look normalised to 0..1: multiply x by the image's width"):
        lifter.lift(POINTS / (640, 480), layout="coco17")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lifter.lift(POINTS, layout="coco17")
        lifter.lift(POINTS / 10, layout="coco17")  # a thermal image of 64x48 pixels


def test_results_print_as_one_short_line(lifter):
    """Their arrays would fill the screen."""
    hidden = POINTS.copy()
    hidden[1] = np.nan
    assert repr(lifter.lift(hidden, layout="coco17")) == "Lifted(2 persons, 1 lifted, model, coco17)"
    S = np.random.default_rng(0).standard_normal((3, 3, 8))
    W = S[:, :2].copy()
    W[2] = 0
    assert repr(onp(S, W)) == "OnP(3 poses, 2 determined, 2 certified, 0 two-fold)"
