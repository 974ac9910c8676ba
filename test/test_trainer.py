# SPDX-License-Identifier: Apache-2.0
"""The training loop: its phases and files, and interruptions that leave no trace in the weights."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_data import sequence, true_start

from paul_ros.layout import load_layout
from paul_ros.orthographic_n_point import onp
from training.checkpoint import LOG_COLUMNS
from training.chirality import rule_share
from training.encoder_fit import fit_encoder
from training.errors import RecipeError, TrainingError
from training.lesson import Lesson
from training.objective import fit
from training.optimiser import one_buffer
from training.recipe import Recipe
from training.reconstruction import final_loss
from training.start import search as starting
from training.start.start import Start
from training.trainer import Trainer
from training.views import NormalisedViews, turned_views

COCO = load_layout("coco17")
TINY = {
    "bottleneck": 3,
    "hidden": [8, 16],
    "width": 16,
    "blocks": 1,
    "batch": 8,
    "handedness_weight": 0,
    "bone_weight": 0,
}
FREE = {**TINY, "codes": "free", "scale": "unit"}
STARTED = {**FREE, "start": "linear", "regression_steps": 6, "steps": 6}
HELD = {**STARTED, "codes": "encoder", "hold": 2}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def searches(monkeypatch):
    """Searches for a start find the truth at once, and are counted."""
    made = []

    def search(kind, W, visible, seed, progress):
        made.append((kind, W, seed))
        return true_start(*sequence())

    monkeypatch.setattr(starting, "search", search)
    return made


def through(run):
    for _ in run.run():
        pass
    return run


def until(run, step):
    for row in run.run():
        if row["step"] == step:
            break
    return run


def same_weights(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.networks.parameters(), b.networks.parameters()))


STOPS = [
    *(
        pytest.param({"codes": codes}, step, id=f"{codes}-{step}")
        for codes in ("free", "encoder")
        for step in (0, 3, 6, 9)
    ),
    *(pytest.param({**HELD, "generations": 2}, step, id=f"held-{step}") for step in (0, 3, 6, 9, 12, 15, 18, 21)),
]


@pytest.mark.parametrize("settings, step", STOPS)
def test_a_run_stopped_anywhere_continues_to_the_bit(tmp_path, searches, step, settings):
    data, _, _ = sequence(hidden=0.2)
    recipe = Recipe.from_dict({**STARTED, **settings, "roll": 1.0})
    whole = through(Trainer(data, recipe, tmp_path / "whole"))
    first = Trainer(data, recipe, tmp_path / "parts")
    if step:
        until(first, step)
    else:
        first.prepare()  # and killed before the first checkpoint
    second = Trainer(data, recipe, tmp_path / "parts")
    assert second.resume() == (step > 0) and second.step == step
    assert same_weights(whole, through(second)) and len(searches) == 2
    assert [row[0] for row in second.rows] == [row[0] for row in whole.rows]


def test_the_search_gets_2d_in_its_unit_and_the_seed(tmp_path, searches):
    data, _, _ = sequence(hidden=0.2)
    for scale in ("unit", "free"):
        recipe = Recipe.from_dict({**STARTED, "scale": scale, "seed": 5})
        Trainer(data, recipe, tmp_path / scale).prepare()
        kind, W, seed = searches[-1]
        assert (kind, seed) == ("linear", 5)
        assert np.sqrt(np.square(W).sum() / data.visible.sum() / 2) == pytest.approx(1, rel=1e-4)
        assert (W[~np.broadcast_to(data.visible[:, None], W.shape)] == 0).all()
    sizes = [np.square(w).sum((1, 2)) / seen.sum() for w, seen in zip(searches[-1][1][:, None], data.visible)]
    np.testing.assert_allclose(sizes, 2, rtol=1e-4)  # every frame by itself where scales are free


@pytest.mark.parametrize("codes", ["free", "encoder"])
@pytest.mark.parametrize("scale", ["unit", "free"])
def test_the_networks_learn_the_starts_shapes(tmp_path, searches, codes, scale):
    recipe = Recipe.from_dict(
        {**STARTED, "codes": codes, "scale": scale, "regression_steps": 300, "steps": 1, "learning_rate": 3e-3}
    )
    run = through(Trainer(sequence()[0], recipe, tmp_path))
    rows = [dict(zip(LOG_COLUMNS, row)) for row in run.rows]
    assert [row["phase"] for row in rows] == ["regression"] * 3 + ["unsupervised"]
    first = next(iter(Trainer(sequence()[0], recipe, tmp_path / "other").run()))
    assert rows[2]["recon_ad"] < 0.35 * first["recon_ad"] and rows[2]["recon_ae"] < 0.5 * first["recon_ae"]


@pytest.mark.parametrize("scale", ["unit", "free"])
def test_held_solutions_are_those_of_the_lower_level(tmp_path, searches, scale):
    """A lesson's shapes explain the frames' own points, and are learned as cameras of other frames see them."""
    data, _, _ = sequence(hidden=0.2)
    run = until(Trainer(data, Recipe.from_dict({**HELD, "scale": scale, "steps": 5}), tmp_path), 9)
    lesson = run._lesson
    S = lesson.shapes_of(torch.arange(40), None).numpy()
    assert onp(S, run.views(torch.arange(40)).W.numpy(), data.visible, scale).residual.max() < 1e-5
    batch = run._sampler.draw(lesson)
    views, rows, goal = batch.views, batch.rows, batch.goal
    assert onp(goal.numpy(), views.W.numpy(), views.visible.numpy(), scale).residual.max() < 1e-5
    assert (views.W - run.views(rows).W).abs().max() > 0.1
    masks = {tuple(mask) for mask in data.visible.tolist()}
    assert {tuple(mask) for mask in views.visible.tolist()} <= masks
    assert not torch.equal(views.visible, run.views(rows).visible)  # what the other cameras saw


def test_held_solutions_are_renewed_as_the_recipe_says(tmp_path, searches, monkeypatch):
    renewed = []
    made = Trainer._solutions
    monkeypatch.setattr(Trainer, "_solutions", lambda run: renewed.append(run.step) or made(run))
    run = through(Trainer(sequence()[0], Recipe.from_dict({**HELD, "steps": 5}), tmp_path))
    assert renewed == [6, 8, 10]
    assert [row[-1] for row in run.rows] == ["regression", "held"]


def test_the_next_generation_starts_afresh_from_what_the_last_explained_best(tmp_path, searches):
    data, _, _ = sequence(hidden=0.2)
    first = through(Trainer(data, Recipe.from_dict(HELD), tmp_path / "first"))
    run = until(Trainer(data, Recipe.from_dict({**HELD, "generations": 2}), tmp_path / "two"), 12)
    assert same_weights(first, run) and run.steps == 24 and not run.finished
    views = first.views(torch.arange(40))
    with torch.no_grad():
        found = fit(first.networks, first.recipe, views, torch.arange(40))
    left = (found.streams.mean(0)[:, :2] - views.W).mul(views.visible[:, None]).flatten(1).norm(dim=1)
    before = [weights.clone() for weights in run.networks.parameters()]
    next(iter(run.run()))
    assert sorted(left.argsort()[:36].tolist()) == run._lesson.rows.tolist()
    moved = [(a - b).abs().max() for a, b in zip(before, run.networks.parameters())]
    assert max(moved) > 0.1  # a step of Adam's would be a thousandth at most


def test_rates_stay_high_for_half_a_generation_of_held_solutions(tmp_path):
    settings = {"regression_steps": 400, "steps": 1600, "generations": 2}
    run = Trainer(sequence()[0], Recipe.from_dict({**HELD, **settings}), tmp_path / "held")
    rates = [run.schedule.rate_factor(step) for step in range(run.steps)]
    assert rates[:2000] == rates[2000:] and rates[0] < 0.01
    assert set(rates[200:1001]) == {1.0} and rates[1500] == pytest.approx(0.5) and rates[1999] < 1e-5
    run = Trainer(sequence()[0], Recipe.from_dict({**HELD, **settings, "generations": 1, "hold": 0}), tmp_path)
    for step, rate in ((300, 0.5 * (1 + np.cos(np.pi * 0.75))), (400, 0.005), (1200, 0.5)):
        assert run.schedule.rate_factor(step) == pytest.approx(rate)


def test_a_start_is_of_the_chirality_that_the_layout_asks_for(tmp_path, monkeypatch):
    data, camera, R = sequence(layout=COCO)
    true = true_start(data, camera, R)
    monkeypatch.setattr(starting, "search", lambda *given: start)
    kept = []
    for start in (true, true.mirrored()):
        run = Trainer(data, Recipe.from_dict(STARTED), tmp_path / str(len(kept)))
        run.prepare()
        kept.append(run.start)
        assert rule_share(run.start.shapes, COCO) > 0.5
    np.testing.assert_allclose(kept[0].shapes, kept[1].shapes, atol=1e-6)
    np.testing.assert_allclose(kept[0].rotations, kept[1].rotations, atol=1e-6)


def test_a_mirrored_start_explains_the_same_views():
    start = true_start(*sequence())
    other = start.mirrored()
    a, b = (s.rotations @ s.shapes for s in (start, other))
    np.testing.assert_allclose(a * [[1], [1], [-1]], b, atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(other.rotations), 1, rtol=1e-5)


def lesson_of(data, start, scale="unit", calibrated=False):
    """The lesson of a start of these frames."""
    W, visible, facing = torch.from_numpy(data.W), torch.from_numpy(data.visible), torch.ones(len(data.W), 1, 1)
    views = NormalisedViews.of(W, visible, facing, calibrated, data.image_unit if scale == "unit" else None)
    return Lesson.of(start, views, data.layout, scale)


def test_a_shape_seen_by_its_own_camera_is_its_view():
    """It is in image units, for a detector's errors are added to it."""
    data, camera, R = sequence(layout=COCO)
    lesson, own = lesson_of(data, true_start(data, camera, R)), torch.arange(40)
    W = lesson.seen_by(own, lesson.shapes_of(own, None)).numpy()
    np.testing.assert_allclose(W, data.W - data.W.mean(2, keepdims=True), atol=1e-3)


def test_where_there_is_perspective_a_shape_is_seen_with_it():
    """Distances are those of the frames: nearer points look larger by their ratio."""
    data, camera, R = sequence(layout=COCO)
    S, distance = camera / 50, np.linspace(20, 60, 40)[:, None, None]
    rays = (S[:, :2] / (distance + S[:, 2:])).astype(np.float32)
    seen = replace(data, W=rays, calibrated=True)
    unit = np.sqrt(((rays - rays.mean(2, keepdims=True)) ** 2).mean((1, 2)))[
        :, None, None
    ]  # of W where starts are found
    start = Start(np.arange(40), (np.swapaxes(R, 1, 2) @ S / distance / unit).astype(np.float32), R, -1, 2.5)
    lesson, own = lesson_of(seen, start, "free", calibrated=True), torch.arange(40)
    W = lesson.seen_by(own, lesson.shapes_of(own, None)).numpy()
    parallel = S[:, :2] / distance
    assert np.abs(W - rays).max() < 0.15 * np.abs(parallel - rays).max()


def test_views_of_held_solutions_have_the_detectors_errors(tmp_path, searches):
    """Most of them have: some are as marked, as the lower level sees them.  Nothing else has errors."""
    data = sequence()[0]
    detected = data.W + 7
    detected[:, :, 0] = np.nan
    run = Trainer(replace(data, detected=detected), Recipe.from_dict(HELD), tmp_path)
    W = torch.rand(40, 2, 9)
    seen, visible = run._sampler.detected_as(torch.arange(40), W)
    reported = ~visible[:, 0]
    assert 20 < reported.sum() < 36
    torch.testing.assert_close(seen[~reported], W[~reported])
    torch.testing.assert_close(seen[reported][:, :, 1:], W[reported][:, :, 1:] + 7, rtol=0, atol=1e-4)
    assert visible[:, 1:].all()
    np.testing.assert_array_equal(run.views(torch.arange(40)).visible.numpy(), data.visible)
    run.prepare()
    views = run._sampler.draw(run._lesson).views
    assert views.visible[:, 1:].all() and not views.visible.all()


def test_starts_are_searched_for_where_perspective_is_least(tmp_path, monkeypatch):
    data, camera, R = sequence(frames=30)
    W = data.W * np.linspace(0.001, 0.002, 30)[:, None, None].astype(np.float32)[::-1]
    far = ((W - W.mean(2, keepdims=True)) ** 2).sum((1, 2)).argsort()
    found = Start(np.array([3, 5]), np.zeros((2, 3, 9), np.float32), R[:2], 0.0, 1.0)
    asked = []
    monkeypatch.setattr(starting, "search", lambda kind, W, *rest: asked.append(W) or found)
    run = Trainer(replace(data, W=W, calibrated=True), Recipe.from_dict({**HELD, "scale": "free"}), tmp_path)
    start = starting.find_start(run.frames, run.recipe, None)
    assert len(asked[0]) == 10
    np.testing.assert_array_equal(start.rows, far[[3, 5]])


def test_a_mirrored_object_has_a_mirrored_shape(tmp_path):
    """The shape to be learned for a view with left and right exchanged fits that view."""
    data, camera, R = sequence(layout=COCO)
    lesson = lesson_of(data, true_start(data, camera, R))
    S = lesson.shapes_of(torch.arange(40), torch.ones(40, 1, 1, dtype=torch.bool)).numpy()
    W = (camera[:, :2] * [[-1], [1]])[:, :, COCO.mirror] / data.image_unit
    found = onp(S, W, data.visible, "unit")
    assert found.residual.max() < 1e-6


def test_a_symmetric_object_mirrored_is_itself():
    """It keeps its chirality and its place in the canonical frame."""
    S = np.random.default_rng(0).standard_normal((3, 17))
    S = S + np.diag([-1, 1, 1]) @ S[:, COCO.mirror]
    S = Rotation.random(random_state=0).as_matrix() @ (S - S.mean(1, keepdims=True))
    start = Start(np.arange(4), np.repeat(S[None], 4, 0).astype(np.float32), np.repeat(np.eye(3)[None], 4, 0), 0, 0)
    lesson = lesson_of(sequence(frames=4, layout=COCO)[0], start)
    plain, mirrored = (lesson.shapes_of(torch.arange(4), flag.expand(4, 1, 1)) for flag in torch.tensor([False, True]))
    torch.testing.assert_close(plain, mirrored, rtol=0, atol=1e-5)


def test_turned_views_are_rotations_or_their_mirror_images():
    turn, facing = turned_views(torch.linspace(0, 6, 8), torch.arange(8) % 2 == 0)
    torch.testing.assert_close(turn @ turn.mT, torch.eye(2).expand(8, 2, 2), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(turn), facing[:, 0, 0])
    assert facing[:, 0, 0].tolist() == [-1, 1] * 4


def test_the_gradient_limit_grows_with_the_norms(tmp_path, monkeypatch):
    limits = []
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda weights, limit: limits.append(limit))
    through(Trainer(sequence(layout=COCO)[0], Recipe.from_dict({**FREE, "steps": 1}), tmp_path))
    assert limits == [pytest.approx(17**0.5)]


@pytest.mark.parametrize("damage", ["junk", "other data"])
def test_a_start_that_is_not_the_runs_is_refused(tmp_path, searches, damage):
    data = sequence()[0]
    Trainer(data, Recipe.from_dict(STARTED), tmp_path).prepare()
    if damage == "junk":
        (tmp_path / "start.npz").write_bytes(b"junk")
    else:
        data = sequence(seed=3)[0]
    with pytest.raises(TrainingError, match="start.npz.*--fresh"):
        Trainer(data, Recipe.from_dict(STARTED), tmp_path).prepare()


def test_full_batches_are_of_all_frames(tmp_path):
    recipe = Recipe.from_dict({**FREE, "batch": 0, "steps": 3})
    run = Trainer(sequence()[0], recipe, tmp_path)
    before = final_loss(run)
    assert next(iter(run.run()))["loss"] == pytest.approx(before, rel=1e-5)


def test_codes_have_a_learning_rate_of_their_own(tmp_path):
    moved = {}
    for rate in (1e-3, 1e-1):
        run = Trainer(
            sequence()[0], Recipe.from_dict({**FREE, "steps": 3, "code_learning_rate": rate}), tmp_path / str(rate)
        )
        before = run.networks.free_codes.weight.detach().clone(), run.networks.decoder[0].weight.detach().clone()
        through(run)
        after = run.networks.free_codes.weight, run.networks.decoder[0].weight
        moved[rate] = [(b - a).abs().max().item() for a, b in zip(before, after)]
    assert moved[1e-1][0] > 30 * moved[1e-3][0] and moved[1e-1][1] < 3 * moved[1e-3][1]


def test_the_auto_decoder_trains_no_shape_encoder(tmp_path):
    run = Trainer(
        sequence()[0], Recipe.from_dict({**FREE, "steps": 5, "streams": "decoder", "decay_weight": 1e-4}), tmp_path
    )
    before = [weight.clone() for weight in run.networks.shape_encoder.parameters()]
    rows = [row["recon_ae"] for row in run.run()]
    assert rows == [0] * 5
    assert all(torch.equal(a, b) for a, b in zip(before, run.networks.shape_encoder.parameters()))


def test_ctrl_c_waits_for_the_step(tmp_path, monkeypatch):
    """It comes in the middle of a step, and the run continues as if it had not."""
    data, recipe = sequence()[0], Recipe.from_dict({**FREE, "steps": 6})
    whole = through(Trainer(data, recipe, tmp_path / "whole"))
    first = Trainer(data, recipe, tmp_path / "parts")
    step = first.optimizer.step

    def interrupted():
        step()
        if first.step == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(first.optimizer, "step", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background has it ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            through(first)
    finally:
        signal.signal(signal.SIGINT, before)
    second = Trainer(data, recipe, tmp_path / "parts")
    assert second.resume() and second.step == 4
    assert same_weights(whole, through(second))


def test_the_encoder_is_fitted_to_free_codes(tmp_path, searches):
    recipe = Recipe.from_dict({**STARTED, "regression_steps": 200, "steps": 1, "learning_rate": 3e-3, "width": 64})
    run = through(Trainer(sequence()[0], recipe, tmp_path))
    codes = run.networks.free_codes.weight.clone()
    decoder = [weight.clone() for weight in run.networks.decoder.parameters()]
    far, near = fit_encoder(run, 1), fit_encoder(run, 400)
    assert near < 0.7 * far
    assert torch.equal(codes, run.networks.free_codes.weight)
    assert all(torch.equal(a, b) for a, b in zip(decoder, run.networks.decoder.parameters()))


BAD = {
    "start": ({"start": "warm"}, "start must be one of"),
    "solver": ({"solver": "fast"}, "solver must be one of"),
    "streams": ({"streams": 2}, "streams"),
    "restarts": ({"restarts": 0}, "restarts"),
    "nothing to do": ({"steps": 0}, "nothing is trained"),
    "start unused": ({"start": "linear"}, "regression_steps"),
    "generations without hold": ({"generations": 2}, "give the recipe hold"),
    "held free codes": ({**STARTED, "hold": 5}, "hold needs codes: encoder"),
    "held random networks": ({"hold": 5}, "a start other than random"),
    "mirrored free codes": ({"codes": "free", "mirror_object": True}, "mirror_object needs codes: encoder"),
}


@pytest.mark.parametrize("name", BAD)
def test_recipes_that_make_no_sense_are_refused(name):
    settings, message = BAD[name]
    with pytest.raises(RecipeError, match=message):
        Recipe.from_dict(settings)


def test_a_recipe_changes_its_base(tmp_path):
    (tmp_path / "mine.yaml").write_text("base: adl\nbottleneck: 5\n")
    assert Recipe.load(tmp_path / "mine.yaml") == replace(Recipe.load("adl"), bottleneck=5)
    for base in ("nothing", "[1]"):
        (tmp_path / "mine.yaml").write_text(f"base: {base}\n")
        with pytest.raises(RecipeError, match="base"):
            Recipe.load(tmp_path / "mine.yaml")


def test_the_papers_recipe_is_the_papers():
    paper = Recipe.load("paper")
    assert paper.hidden[::-1] == (256, 128, 64, 32, 16) and paper.bottleneck == 8
    assert (paper.code_weight, paper.decay_weight, paper.solver, paper.start) == (0.01, 1e-4, "algebraic", "random")
    beyond = (paper.handedness_weight, paper.bone_weight, paper.nuclear_weight, paper.roll)
    assert not any(beyond) and not paper.mirror_view and not paper.mirror_object


# --- one buffer for all weights


def test_adam_on_one_buffer_is_adam_on_each_parameter():
    torch.manual_seed(0)
    layers = [torch.nn.Linear(5, 7) for _ in range(2)]
    layers[1].load_state_dict(layers[0].state_dict())
    trained = [one_buffer(list(layers[0].parameters()))], list(layers[1].parameters())
    optimizers = [torch.optim.Adam(parameters, lr=0.1) for parameters in trained]
    for x in torch.randn(4, 9, 5):
        for layer, parameters, optimizer in zip(layers, trained, optimizers):
            optimizer.zero_grad(set_to_none=False)
            layer(x).square().mean().backward()
            torch.nn.utils.clip_grad_norm_(parameters, 0.1)
            optimizer.step()
    for a, b in zip(*(layer.parameters() for layer in layers)):
        torch.testing.assert_close(a, b)


def test_a_continued_run_still_trains_the_weights_of_its_networks(tmp_path):
    data, _, _ = sequence()
    recipe = Recipe.from_dict({**FREE, "steps": 4})
    until(Trainer(data, recipe, tmp_path), 2)
    again = Trainer(data, recipe, tmp_path)
    assert again.resume()
    before = [weight.clone() for weight in again.networks.decoder.parameters()]
    through(again)
    assert all(not torch.equal(a, b) for a, b in zip(before, again.networks.decoder.parameters()))
