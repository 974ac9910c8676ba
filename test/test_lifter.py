# SPDX-License-Identifier: Apache-2.0
"""The Lifter and the placement: geometry that must hold for every model, and persons that are rejected."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import PERSON, coco_model, persons_at
from scipy.spatial.transform import Rotation

from msg_adapters.intrinsics import Intrinsics
from paul_ros import shape_fit
from paul_ros.errors import InputError, ModelError
from paul_ros.layout import load_layout
from paul_ros.lift_arguments import HEIGHTS
from paul_ros.lifted import BEHIND_CAMERA, DEGENERATE_POINTS, TOO_FAR, TOO_FEW_POINTS
from paul_ros.lifter import Lifter
from paul_ros.model_file import load_model
from paul_ros.placement import centred_view
from paul_ros.shape_fit import fit_shapes
from paul_ros.stream.parameters import PARAMETERS

CAMERA = Intrinsics(900.0, 900.0, 640.0, 360.0, 1280, 720)


@pytest.fixture(scope="module")
def model():
    return replace(coco_model(), header={**coco_model().header, "misfit": None})


@pytest.fixture(scope="module")
def rigid_lifter(model):
    """Return a lifter whose shape is known exactly, so that geometry can be checked exactly."""
    return Lifter(model.rigid())


def test_models_of_one_fixed_scale_are_refused(model):
    fixed = replace(model, header={**model.header, "scale": "unit", "image_unit": 1.0})
    with pytest.raises(ModelError, match="one fixed scale.*paul evaluate"):
        Lifter(fixed)


def pinhole(points):
    return points[..., :2] / points[..., 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]


def standing(model, position, turn=0.0):
    """Return the mean shape in metres, somewhere in front of the camera: (1,P,3)."""
    shape = Rotation.from_euler("y", turn).as_matrix() @ model.mean_shape * model.metres_per_unit
    return (shape.T + position)[None]


def everything(points):
    return np.ones(points.shape[:2], bool)


@pytest.mark.parametrize("position", [[0, 0, 6], [2.5, 0.3, 6], [-2, -0.5, 5], [0, 0, 1.5], [0.5, 0.3, 1.5]])
def test_a_known_shape_is_put_where_it_stands(rigid_lifter, model, position):
    truth = standing(model, position, turn=0.5)
    lifted = rigid_lifter.lift(pinhole(truth), everything(truth), CAMERA)
    assert lifted.units == "m" and lifted.ok.all() and lifted.certified.all()
    np.testing.assert_allclose(lifted.points, truth, atol=0.003)
    np.testing.assert_allclose(lifted.root, truth[:, [11, 12]].mean(1), atol=0.003)
    assert lifted.reprojection < 0.2  # pixels


def test_off_centre_persons_are_not_bent(rigid_lifter, model):
    """Without the virtual camera a person at the image border comes out turned by the angle of its ray."""
    angles = []
    for x in (0.0, 3.0):
        truth = standing(model, [x, 0.0, 6.0])
        lifted = rigid_lifter.lift(pinhole(truth), everything(truth), CAMERA)
        angles.append(np.degrees(Rotation.from_matrix(lifted.rotation[0]).magnitude()))
    assert abs(angles[1] - angles[0]) < 4


def test_without_intrinsics_output_is_in_model_units_from_the_root(rigid_lifter, model):
    truth = standing(model, [0, 0, 8])
    lifted = rigid_lifter.lift(pinhole(truth), everything(truth))
    assert lifted.units == "model"
    np.testing.assert_allclose(lifted.root, 0, atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(lifted.points[0] - lifted.points[0].mean(0)),
        np.linalg.norm(model.mean_shape - model.mean_shape.mean(1, keepdims=True)),
        rtol=1e-5,
    )


@pytest.mark.parametrize("seed", range(5))
def test_in_model_units_points_are_in_the_cameras_frame_as_in_metres(model, seed):
    """A model that does not know its metres differs in the origin and the unit only, wherever a person stands."""
    unscaled = replace(model, header={**model.header, "metres_per_unit": None, "stature": None})
    rng = np.random.default_rng(seed)
    truth = np.concatenate([standing(model, rng.uniform([-5, -2, 5], [5, 2, 9]), rng.uniform(0, 6)) for _ in range(8)])
    xy, visible = pinhole(truth) + rng.normal(0, 3, truth[..., :2].shape), rng.random(truth.shape[:2]) > 0.2
    metric, plain = (Lifter(each).lift(xy, visible, CAMERA) for each in (model, unscaled))
    assert metric.units == "m" and plain.units == "model" and metric.ok.sum() > 6
    ok, unit = metric.ok, model.metres_per_unit
    np.testing.assert_allclose(plain.points[ok] * unit, (metric.points - metric.root[:, None])[ok], atol=1e-9)
    np.testing.assert_allclose(plain.rotation[ok], metric.rotation[ok], atol=1e-9)


def test_twice_as_far_is_half_as_large(rigid_lifter, model):
    near, far = (
        rigid_lifter.lift(pinhole(p), everything(p), CAMERA)
        for p in (standing(model, [0, 0, 5.0]), standing(model, [0, 0, 10.0]))
    )
    np.testing.assert_allclose(near.scale / far.scale, 2, rtol=0.02)


def test_too_few_points_are_not_lifted_and_the_others_are(model):
    truth = np.concatenate([standing(model, [0, 0, 5]), standing(model, [1, 0, 5])])
    visible = everything(truth)
    visible[0, model.min_visible - 1 :] = False
    lifted = Lifter(model).lift(pinhole(truth), visible, CAMERA)
    assert lifted.reason == (TOO_FEW_POINTS, "")
    assert np.isnan(lifted.points[0]).all() and np.isfinite(lifted.points[1]).all()


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_unexplained_is_a_share_of_the_extent(rigid_lifter, model, camera):
    """At any size in the image: near 0 for the model's own shape, near 1 for points in another order."""
    truth = np.concatenate([standing(model, [0, 0, 4]), standing(model, [0, 0, 8])])
    order = np.random.default_rng(0).permutation(17)
    right, wrong = (rigid_lifter.lift(pinhole(some), everything(truth), camera) for some in (truth, truth[:, order]))
    # Without intrinsics the perspective is not explained.
    assert right.unexplained.max() < (0.03 if camera else 0.1) and wrong.unexplained.min() > 0.6
    extent = np.sqrt(pinhole(truth).var(1).sum(1))
    np.testing.assert_allclose(wrong.unexplained, wrong.reprojection / extent, rtol=0.03)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.6])
def test_any_subset_of_enough_points_is_lifted_to_finite_points(model, share):
    rng = np.random.default_rng(0)
    truth = standing(model, [0, 0, 5])
    visible = np.stack([rng.permutation(17) >= int(share * 17) for _ in range(50)])
    xy = np.where(visible[..., None], np.repeat(pinhole(truth), 50, 0), np.nan)
    lifted = Lifter(model).lift(xy, visible, CAMERA)
    assert lifted.ok.all() and np.isfinite(lifted.points).all() and np.isfinite(lifted.ambiguity).all()
    np.testing.assert_allclose(np.linalg.det(lifted.rotation), 1)


def test_points_beyond_the_horizon_do_not_count_as_seen(model):
    """Five far to the right, three far to the left: the virtual camera sees fewer than the minimum."""
    visible = np.arange(17)[None] < model.min_visible + 2
    xy = np.random.default_rng(0).normal(360, 50, (1, 17, 2))
    xy[0, :5, 0] = 1e6
    xy[0, 5:, 0] = -1e6
    view = centred_view(xy, visible, CAMERA)
    np.testing.assert_array_equal(np.isfinite(view.W).all(1), view.seen)
    assert view.seen.sum() < model.min_visible
    assert Lifter(model).lift(xy, visible, CAMERA).reason == (TOO_FEW_POINTS,)


def test_all_points_at_one_pixel_are_refused(model):
    lifted = Lifter(model).lift(np.full((1, 17, 2), 300.0), np.ones((1, 17), bool), CAMERA)
    assert lifted.reason == (DEGENERATE_POINTS,)


def test_persons_within_about_a_pixel_are_refused_and_the_others_are_not(model):
    """They would be lifted with a certificate, tens of kilometres away."""
    truth = np.concatenate([standing(model, [0, 0, 5])] * 3)
    xy = pinhole(truth)
    centre = xy.mean(1, keepdims=True)
    extent = np.sqrt(((xy - centre) ** 2).sum(2).mean(1))[:, None, None]
    xy = centre + (xy - centre) / extent * np.array([0.001, 0.9, 30])[:, None, None]
    lifted = Lifter(model).lift(xy, everything(truth), CAMERA)
    assert lifted.reason == (DEGENERATE_POINTS, DEGENERATE_POINTS, "")
    np.testing.assert_array_equal(np.isfinite(lifted.points).all((1, 2)), [False, False, True])
    assert not lifted.certified[:2].any()


def test_hidden_points_do_not_add_to_a_persons_extent(model):
    xy = np.random.default_rng(0).normal(300, 0.3, (1, 17, 2))
    xy[0, :5] = 900
    visible = np.arange(17)[None] >= 5
    assert Lifter(model).lift(xy, visible, CAMERA).reason == (DEGENERATE_POINTS,)


@pytest.mark.parametrize("camera", [CAMERA, None])
@pytest.mark.parametrize("breadth, fixed", [(0.0, False), (0.004, False), (0.006, True)])
def test_persons_on_one_line_are_refused(model, camera, breadth, fixed):
    """The line may slant; breadth is its spread over its length. Such persons had a certificate and no ambiguity."""
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(20, 17, 2))
    flat -= flat.mean(1, keepdims=True)
    flat = flat @ np.linalg.svd(flat, full_matrices=False)[2].transpose(0, 2, 1)
    flat *= np.array([1, breadth]) / np.sqrt((flat * flat).mean(1, keepdims=True))
    turns = Rotation.from_rotvec(rng.uniform(0, np.pi, (20, 1)) * [0, 0, 1]).as_matrix()[:, :2, :2]
    xy = (640, 360) + 80 * flat @ turns
    assert set(Lifter(model.rigid()).lift(xy, everything(xy), camera).reason) == {"" if fixed else DEGENERATE_POINTS}


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_persons_in_two_places_are_refused(model, camera):
    xy = np.where(np.arange(17)[:, None] < 5, (600.0, 300.0), (650.0, 400.0))[None]
    assert Lifter(model).lift(xy, everything(xy), camera).reason == (DEGENERATE_POINTS,)


def test_persons_seen_from_the_side_are_lifted(rigid_lifter, model):
    truth = np.concatenate([standing(model, [0, 0, 5], turn) for turn in np.linspace(0, np.pi, 37)])
    assert rigid_lifter.lift(pinhole(truth), everything(truth), CAMERA).ok.all()


@pytest.mark.parametrize("distance, reason", [(180, ""), (220, TOO_FAR)])
def test_persons_are_lifted_up_to_a_stated_distance(rigid_lifter, model, distance, reason):
    truth = standing(model, [0, 0, distance])
    lifted = rigid_lifter.lift(pinhole(truth), everything(truth), CAMERA)
    assert lifted.reason == (reason,) and np.isfinite(lifted.points).all() == (reason == "")


def test_lifted_persons_are_in_front_of_the_camera(model):
    """Points all over a field of nearly 180 degrees: lifted shapes reach behind the camera, some with their roots."""
    wide = Intrinsics(90.0, 90.0, 640.0, 360.0, 1280, 720)
    xy = np.random.default_rng(0).uniform(-1400, 2700, (500, 17, 2))
    lifted = Lifter(model).lift(xy, everything(xy), wide)
    assert set(lifted.reason) >= {"", BEHIND_CAMERA}
    assert lifted.root[lifted.ok, 2].min() > 0
    assert lifted.points[lifted.used & lifted.ok[:, None], 2].min() > 0
    behind = np.array(lifted.reason) == BEHIND_CAMERA
    assert np.isnan(lifted.points[behind]).all() and not lifted.certified[behind].any()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("camera", [CAMERA, None])
@pytest.mark.parametrize("far", [1.1e6, -1e155, 1e305, np.inf])
def test_points_where_no_image_is_count_as_hidden(model, camera, far):
    truth = standing(model, [0, 0, 5])
    xy, visible = pinhole(truth), everything(truth)
    xy[0, :3, 1] = far
    visible[0, :3] = False
    np.testing.assert_array_equal(
        Lifter(model).lift(xy, everything(truth), camera).points, Lifter(model).lift(xy, visible, camera).points
    )


def test_without_intrinsics_there_is_no_distance_to_exceed(rigid_lifter, model):
    truth = standing(model, [0, 0, 500.0])
    assert rigid_lifter.lift(pinhole(truth), everything(truth)).ok.all()


@pytest.mark.parametrize("focal", [1e-300, 1e300])
def test_no_camera_makes_it_answer_what_float32_cannot_hold(model, focal):
    truth = standing(model, [0, 0, 5])
    camera = Intrinsics(focal, focal, 640.0, 360.0, 0, 0)
    with np.errstate(all="ignore"):
        lifted = Lifter(model).lift_in_model_layout(pinhole(truth), everything(truth), camera)
    assert not lifted.ok.any() and np.isnan(lifted.points).all()


def test_nan_marked_visible_counts_as_hidden(model):
    truth = standing(model, [0, 0, 5])
    xy = pinhole(truth)
    xy[0, :3] = np.nan
    assert np.isfinite(Lifter(model).lift(xy, everything(truth), CAMERA).points).all()


def test_nobody(model):
    lifted = Lifter(model).lift(np.empty((0, 17, 2)), np.empty((0, 17), bool), CAMERA)
    assert lifted.points.shape == (0, 17, 3) and lifted.reason == ()


def test_persons_do_not_influence_each_other(model):
    truth = np.concatenate([standing(model, [x, 0, 5], turn=x) for x in (-1.0, 0.0, 1.0)])
    together = Lifter(model).lift(pinhole(truth), everything(truth), CAMERA)
    alone = Lifter(model).lift(pinhole(truth[1:2]), everything(truth[1:2]), CAMERA)
    np.testing.assert_allclose(together.points[1:2], alone.points, atol=1e-5)


def test_wrong_shapes_are_refused(model):
    with pytest.raises(ValueError, match="coco17"):
        Lifter(model).lift(np.zeros((1, 18, 2)), np.ones((1, 18), bool))


def test_the_virtual_camera_looks_at_the_person():
    truth = np.random.default_rng(0).standard_normal((3, 17, 3)) * 0.3 + [[[2, 1, 4]], [[-3, 0, 5]], [[0, -1, 3]]]
    view = centred_view(pinhole(truth), everything(truth), CAMERA)
    assert np.abs(view.W.mean(2)).max() < 0.02
    np.testing.assert_allclose(np.linalg.det(view.turn), 1)
    vectors = Rotation.from_matrix(view.turn).as_rotvec()
    np.testing.assert_allclose(vectors[:, 2], 0, atol=1e-12)  # the smallest rotation does not roll
    seen = np.einsum("nji,npj->nip", view.turn, truth)
    np.testing.assert_allclose(view.W, seen[:, :2] / seen[:, 2:], atol=1e-9)


@pytest.mark.parametrize("degrees, seen", [(58, True), (59.9, True), (60.1, False), (62, False)])
def test_points_farther_than_60_degrees_from_the_person_are_misdetections(degrees, seen):
    """Two of them, one on each side, so that the person's direction stays where the other points are."""
    xy = np.full((1, 17, 2), (CAMERA.cx, CAMERA.cy))
    xy[0, :2, 0] += np.array([-1, 1]) * CAMERA.fx * np.tan(np.radians(degrees))
    view = centred_view(xy, everything(xy), CAMERA)
    np.testing.assert_array_equal(view.seen[0], [seen, seen] + [True] * 15)


def test_one_wild_detection_does_not_turn_the_virtual_camera_away(model):
    truth = standing(model, [0.5, 0, 5])
    xy = pinhole(truth)
    xy[0, 0] = [9e5, -9e5]
    lifted = Lifter(model.rigid()).lift(xy, everything(truth), CAMERA)
    assert lifted.ok.all() and np.linalg.norm(lifted.root - truth[:, [11, 12]].mean(1)) < 0.1


@pytest.fixture(scope="module")
def exact_lifter(model_file):
    """Return a lifter whose model always answers with PERSON."""
    return Lifter(load_model(model_file))


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_misdetections_are_not_used(exact_lifter, camera):
    """One wrist taken from another person: the rest is lifted as if it had been hidden."""
    truth = persons_at((0, 0, 4), (0.5, 0, 4), (-0.5, 0, 4))
    xy = pinhole(truth)
    xy[0, 9] += (50, 30)
    visible = everything(truth)
    lifted = exact_lifter.lift(xy, visible, camera)
    assert not lifted.used[0, 9] and lifted.used.sum() == 3 * 17 - 1
    hidden = visible.copy()
    hidden[0, 9] = False
    np.testing.assert_allclose(lifted.points, exact_lifter.lift(xy, hidden, camera).points, atol=1e-4)


def test_points_that_miss_by_more_than_35_percent_of_the_extent_are_misdetections(exact_lifter):
    """A hip moved away step by step; the share is that of the fit with all points."""
    model, count = exact_lifter.model, 60
    W = np.repeat(PERSON.T[None, :2], count, axis=0)
    W[:, 0, 11] += np.linspace(0.1, 0.8, count)
    visible = np.ones((count, 17), bool)
    fit = shape_fit._fit(model, W, visible, pinhole=False)
    share = np.sqrt(fit.square[:, 11]) / fit.extent
    assert ((share > 0.33) & (share < 0.35)).any() and ((share > 0.35) & (share < 0.37)).any()
    used = fit_shapes(model, W, visible, pinhole=False).used
    np.testing.assert_array_equal(used[:, 11], share <= 0.35)
    assert np.delete(used, 11, axis=1).all()


def test_in_a_bad_fit_only_points_that_miss_by_more_than_3_medians_are_misdetections(exact_lifter):
    W, visible = PERSON.T[None, :2], np.ones((1, 17), bool)
    fit = shape_fit._fit(exact_lifter.model, W, visible, pinhole=False)
    missed = np.full((1, 17), 0.2)
    missed[0, 4], missed[0, 9] = 0.59, 0.61
    wild = shape_fit._misdetections(fit._replace(square=missed**2, extent=np.ones(1)))
    assert np.flatnonzero(wild[0]).tolist() == [9]


def test_points_that_all_fit_are_all_used(exact_lifter):
    """Noise of a hundredth of a pixel makes no misdetections, however its sizes differ."""
    truth = np.repeat(persons_at((0, 0, 4)), 50, axis=0)
    xy = pinhole(truth) + np.random.default_rng(0).standard_t(1, (50, 17, 2)).clip(-20, 20) * 0.01
    assert exact_lifter.lift(xy, everything(truth), CAMERA).used.all()


def test_the_rigid_baseline_doubts_no_detector(rigid_lifter, model):
    xy = pinhole(standing(model, [0, 0, 4]))
    xy[0, 9] += (50, 30)
    assert rigid_lifter.lift(xy, np.ones((1, 17), bool), CAMERA).used.all()


def with_misfit(model, misfit):
    return replace(model, header={**model.header, "misfit": misfit})


def bent(offset=0.03):
    """Return PERSON 4 m away with every point a little out of place, (1,17,3) metres."""
    return persons_at((0.3, 0, 4)) + offset * np.random.default_rng(0).standard_normal((1, 17, 3))


def test_points_are_where_they_are_seen_if_the_model_is_trusted_less(model):
    """S_cam of the paper: with a large misfit every visible point projects to its pixel; hidden ones stay."""
    truth = bent()
    visible = everything(truth)
    visible[:, 3] = False
    by_model, as_seen = (Lifter(with_misfit(model, size)).lift(pinhole(truth), visible, CAMERA) for size in (None, 100))
    np.testing.assert_allclose(pinhole(as_seen.points)[visible], pinhole(truth)[visible], atol=1e-6)
    assert np.abs(pinhole(by_model.points) - pinhole(truth))[visible].max() > 1
    np.testing.assert_array_equal(as_seen.reprojection, by_model.reprojection)  # the model's own, which measures doubt
    np.testing.assert_allclose(as_seen.points[:, 3], by_model.points[:, 3], atol=1e-9)


def test_without_intrinsics_points_are_where_they_are_seen_too(model):
    """Under weak perspective: in the image plane, of one scale."""
    truth = bent()
    lifted = Lifter(with_misfit(model, 100.0)).lift(pinhole(truth), everything(truth))
    seen = pinhole(truth) - pinhole(truth)[:, [11, 12]].mean(1, keepdims=True)
    np.testing.assert_allclose(lifted.points[..., :2] * lifted.scale, seen, atol=1e-6)


def test_a_point_seen_far_from_where_the_model_puts_it_moves_less(model):
    """Beyond two standard deviations it moves by the square of (two deviations over the distance)."""
    xy, visible = pinhole(bent()), everything(bent())
    exact, lifted = (Lifter(with_misfit(model, size)).lift(xy, visible, CAMERA).points[0] for size in (100.0, None))
    virtual = centred_view(xy, visible, CAMERA).turn[0]
    off = np.linalg.norm(((exact - lifted) @ virtual)[:, :2], axis=1)
    limit = np.median(off)
    some = Lifter(with_misfit(model, limit / 2 / model.metres_per_unit)).lift(xy, visible, CAMERA).points[0]
    share = np.linalg.norm(some - lifted, axis=1) / off
    np.testing.assert_allclose(share, np.minimum(1, (limit / off) ** 2), rtol=1e-6)


def test_the_rigid_baseline_is_not_moved(model):
    truth = bent()
    a, b = (
        Lifter(with_misfit(model, size).rigid()).lift(pinhole(truth), everything(truth), CAMERA) for size in (None, 1)
    )
    np.testing.assert_array_equal(a.points, b.points)


def test_the_root_is_the_middle_of_the_hips():
    """In the shipped model's layout, pelvis and neck are points of their own for every detector."""
    lifter, truth = Lifter(load_model()), persons_at((0.3, 0, 4), (-1, 0, 5), (1, 0, 5))
    own, point = lifter.model.layout, lifter.model.layout.names.index
    xy, confidence, visible = load_layout("coco17").map_to(own)(pinhole(truth), np.ones((3, 17)), everything(truth))
    visible[1, [point("left_hip"), point("pelvis")]] = False
    visible[2, point("left_hip")] = False  # the pelvis is seen, and counts more than the hidden hip
    for camera in (CAMERA, None):
        lifted = lifter.lift(xy, visible, camera)
        for middle, sides in (("pelvis", ["left_hip", "right_hip"]), ("neck", ["left_shoulder", "right_shoulder"])):
            off = lifted.points[:, point(middle)] - lifted.points[:, [point(side) for side in sides]].mean(1)
            np.testing.assert_allclose(off[:2], 0, atol=1e-12)
        np.testing.assert_array_equal(lifted.root, lifted.points[:, point("pelvis")])
        hips = lifted.points[2, [point("left_hip"), point("right_hip")]].mean(0)
        assert np.linalg.norm(lifted.root[2] - hips) > 1e-3


@pytest.mark.parametrize("height", [170, 5.7, 0.1, -1.7, float("nan"), "1.7", None])
def test_a_height_that_is_no_persons_in_metres_is_refused(height):
    with pytest.raises(InputError, match="pass metres, from 0.3 to 3"):
        Lifter("human", person_height=height)
    assert [(row.least, row.limits[1]) for row in PARAMETERS if row.name == "person_height"] == [HEIGHTS]


def test_ragged_arrays_are_refused():
    ragged = [[[1, 2]] * 43, [[1, 2]] * 42]
    with pytest.raises(InputError, match="arrays of numbers"):
        Lifter("human").lift_in_model_layout(ragged, np.ones((2, 43), bool))
    with pytest.raises(InputError, match="arrays of numbers"):
        Lifter("human").lift_in_model_layout(np.ones((2, 43, 2)), [[True] * 43, [True] * 42])


def test_points_of_another_number_are_told_layouts_that_fit_the_model():
    with pytest.raises(InputError, match="layout='coco17'; these have so many points: coco17, h36m17$"):
        Lifter("human").lift(np.ones((1, 17, 2)))
