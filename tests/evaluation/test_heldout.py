"""Every number of held-out frames against NumPy, and which numbers there are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.scene import scene as splat_scene
from nerfies_jax import evaluation, runs
from nerfies_jax.capture import synthetic
from nerfies_jax.evaluation import heldout, model_flow, protocol
from nerfies_jax.evaluation.baseline_images import Averages, Baselines
from nerfies_jax.evaluation.heldout import heldout_metrics
from nerfies_jax.evaluation.model_flow import Flow, Moved
from nerfies_jax.evaluation.scores import Scored
from nerfies_jax.fields.effects.warp import WarpSpec
from nerfies_jax.fields.spec import RadianceScene, SamplingSpec
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.metrics import image_quality, perceptual
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.runs import quality, representations
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.scene import scene
from nerfies_jax.training.model import TrainState
from tests import scene_oracle, scenes
from tests.metrics.test_perceptual import TINY, state_dict

# Two frames of the second camera: one has a next one, so a flow.
SCENE = dataclasses.replace(scenes.TINY_SCENE, heldout_every=2)
NOBODY = TrainState((), (), (), jnp.zeros((), jnp.int32), jax.random.key(0))
ALWAYS = {"heldout.psnr", "heldout.ssim"}
MASKED = {f"heldout.{name}" for name in ("moving_psnr", "moving_ssim", "static_psnr")}
BASELINES = {
    *(f"baseline.{name}" for name in ("neighbor_mean", "static")),
    *(f"motion.{name}" for name in ("gain", "moving_gain")),
}
DEPTHS = {
    *(f"heldout.depth_{kind}" for kind in ("abs_rel", "within_delta")),
    *(f"heldout.{of}depth_{k}" for of in ("", "moving_") for k in ("median", "rmse")),
}
TRUTH = {
    *(f"flow.{kind}" for kind in ("epe", "outliers", "missing", "moving_epe")),
    *(f"tracks.{kind}" for kind in ("epe", "static_epe", "correct", "lost", "drift")),
}


def random_renders(capture, rng):
    """Held-out frames as a poor scene might draw them."""
    rows = capture.heldout
    truth = capture.images[rows] / 255
    color = np.clip(truth + 0.1 * rng.normal(size=truth.shape), 0, 1)
    near = np.ones(truth.shape[:3]) if capture.depths is None else capture.depths[rows]
    depth = near * rng.uniform(0.7, 1.4, near.shape)
    psnr = np.arange(len(rows)) + 20.0
    return Scored(
        rows,
        np.float32(color),
        np.ones(near.shape, np.float32),
        np.float32(depth),
        psnr,
        psnr / 100,
    )


masked_ssim = jax.jit(image_quality.masked_ssim)


def psnr(image, truth, mask):
    return -10 * np.log10(np.mean((image - truth)[mask] ** 2))


def test_a_frame_of_which_nothing_was_observed_spoils_no_mean(rng):
    capture = scenes.tiny_capture()
    scored = random_renders(capture, rng)
    twice = Scored(*(np.concatenate([leaf, leaf]) for leaf in scored))
    twice = twice._replace(psnr=np.array([np.nan, 21.0]), ssim=np.array([np.nan, 0.5]))
    numbers = heldout_metrics(twice, capture)
    assert numbers["heldout.psnr"] == 21
    assert numbers["heldout.ssim"] == 0.5
    nothing = scored._replace(psnr=np.array([np.nan]))
    assert np.isnan(heldout_metrics(nothing, capture)["heldout.psnr"])


@pytest.mark.parametrize("masked", [True, pytest.param(False, marks=pytest.mark.full)])
def test_every_number_is_that_of_a_direct_computation(rng, masked):
    capture = scenes.tiny_capture()
    valid = rng.random(capture.moving.shape) > 0.2
    if masked:
        capture = dataclasses.replace(capture, valid=valid)
    scored = random_renders(capture, rng)
    places = np.array([len(scored.rows) - 1])
    gray = Averages(places, np.full_like(scored.color[places], 0.4), None)
    baselines = Baselines(gray._replace(known=~valid[scored.rows[places]]), gray)
    numbers = heldout_metrics(scored, capture, baselines=baselines)
    unscored = {"heldout.unscored"} if masked else set()
    lost = (
        {"baseline.neighbor_mean"} if masked else set()
    )  # what is known was not observed
    assert set(numbers) == (ALWAYS | MASKED | DEPTHS | BASELINES | unscored) - lost
    assert numbers["heldout.psnr"] == pytest.approx(scored.psnr.mean())
    rows = capture.heldout
    image = np.round(scored.color.astype(float) * 255) / 255
    truth = capture.images[rows] / 255
    known = valid[rows] if masked else np.ones_like(valid[rows])
    moving = capture.moving[rows]
    for name, mask in (("moving", moving & known), ("static", ~moving & known)):
        frames = zip(image, truth, mask, strict=True)
        exact = np.mean([psnr(*frame) for frame in frames])
        assert numbers[f"heldout.{name}_psnr"] == pytest.approx(exact, abs=1e-4)
    for key, mask in (("gain", known[-1]), ("moving_gain", (moving & known)[-1])):
        own = psnr(image[-1], truth[-1], mask)
        gain = own - psnr(np.full_like(truth[-1], 102 / 255), truth[-1], mask)
        assert numbers[f"motion.{key}"] == pytest.approx(gain, abs=1e-4)
    if masked:
        share = 1 - valid[rows].mean()
        assert numbers["heldout.unscored"] == pytest.approx(share)
    ssim = [
        masked_ssim(np.float32(a), np.float32(b), m)
        for a, b, m in zip(image, truth, moving & known, strict=True)
    ]
    assert numbers["heldout.moving_ssim"] == pytest.approx(np.mean(ssim), abs=1e-5)
    depth = capture.depths[rows]
    for name, mask in (("", depth > 0), ("moving_", (depth > 0) & moving)):
        error = np.abs(scored.depth - depth)[mask]
        exact = {"median": np.median(error), "rmse": np.sqrt(np.mean(error**2))}
        for kind, value in exact.items():
            key = f"heldout.{name}depth_{kind}"
            assert numbers[key] == pytest.approx(value, rel=1e-4)
    ratio = (scored.depth / depth)[depth > 0]
    assert numbers["heldout.depth_abs_rel"] == pytest.approx(
        np.abs(ratio - 1).mean(), rel=1e-4
    )
    assert numbers["heldout.depth_within_delta"] == pytest.approx(
        np.mean(np.maximum(ratio, 1 / ratio) < 1.25), abs=1e-3
    )


def test_what_a_capture_has_not_is_not_among_the_numbers(rng):
    capture = scenes.tiny_capture()
    bare = dataclasses.replace(capture, moving=None, depths=None)
    assert set(heldout_metrics(random_renders(bare, rng), bare)) == ALWAYS
    still = dataclasses.replace(capture, moving=np.zeros_like(capture.moving))
    numbers = heldout_metrics(random_renders(still, rng), still)
    assert "heldout.static_psnr" in numbers
    assert not [key for key in numbers if "moving" in key]
    listed = {metric.key: metric.value for metric in heldout.metrics(numbers)}
    assert listed == numbers


@pytest.mark.full
def test_large_images_get_ms_ssim_and_weights_lpips(rng, tmp_path):
    small = scenes.tiny_capture()
    rows = small.heldout[:1]
    capture = dataclasses.replace(
        small,
        images=small.images.repeat(6, 1).repeat(6, 2),
        cameras=cameras.resize(small.cameras, (1, 1), (6, 6)),
        heldout=rows,
        moving=None,
        depths=None,
        flow=None,
    )
    np.savez(tmp_path / "tiny.npz", **state_dict("tiny", rng))
    lpips = heldout.Lpips(TINY, perceptual.load(TINY, [tmp_path / "tiny.npz"]))
    scored = random_renders(capture, rng)
    numbers = heldout_metrics(scored, capture, lpips=lpips)
    assert set(numbers) == ALWAYS | {"heldout.ms_ssim", "heldout.lpips"}
    image = np.round(scored.color[0] * 255) / np.float32(255)
    truth = np.float32(capture.images[rows[0]] / 255)
    exact = jax.jit(image_quality.ms_ssim)(image, truth)
    assert numbers["heldout.ms_ssim"] == pytest.approx(float(exact), abs=1e-5)
    exact = jax.jit(perceptual.lpips, static_argnums=1)(
        lpips.params, TINY, image, truth
    )
    assert numbers["heldout.lpips"] == pytest.approx(float(exact), rel=1e-4)

    valid = np.ones(capture.images.shape[:3], bool)
    valid[:, :, 100:] = False
    capture = dataclasses.replace(capture, valid=valid)
    numbers = heldout_metrics(scored, capture, lpips=lpips)
    assert "heldout.ms_ssim" not in numbers  # it has no masked form
    exact = jax.jit(perceptual.masked_lpips, static_argnums=1)(
        lpips.params, TINY, image, truth, valid[rows[0]]
    )
    assert numbers["heldout.lpips"] == pytest.approx(float(exact), rel=1e-4)
    with pytest.raises(ValueError, match="9 pixels on the shorter side"):
        perceptual.check_large_enough(TINY, (40, 8))


@pytest.mark.parametrize("double", [False, True])
def test_flow_is_scored_where_there_is_an_answer(double):
    truth = np.zeros((5, 2))
    predicted = np.array([[3, 4], [0, 1], [np.nan, 0], [0, 0], [0, 2.0]])
    moving = np.array([True, False, True, False, True])
    kinds = np.float64 if double else np.float32, np.float32  # of a run; of a capture
    with jax.enable_x64(double):
        predicted, truth = map(np.asarray, (predicted, truth), kinds)
        scored = heldout._flow(Flow(predicted, truth, moving))
    assert scored["flow.epe"] == pytest.approx((5 + 1 + 0 + 2) / 4)
    assert scored["flow.moving_epe"] == pytest.approx((5 + 2) / 2)
    assert scored["flow.outliers"] == pytest.approx(2 / 5)
    assert scored["flow.missing"] == pytest.approx(1 / 5)


@pytest.mark.full
def test_the_flow_of_a_known_motion_is_the_true_one():
    """Points moved as the scene moves them, at the true depths: the true flow."""
    capture, truth = synthetic.make(SCENE)
    lost = 7

    def move(state, points, here, there):
        row = int(np.argmin(abs(capture.times[capture.heldout] - float(here.time))))
        row = capture.heldout[row]
        camera = cameras.take(capture.cameras, row)
        place = scene_oracle.project(camera, points)
        np.testing.assert_allclose(place % 1, 0.5, atol=2e-2)
        column, line = np.floor(place).astype(int).T
        ahead = (points - camera.position) @ camera.camera_from_world[2]
        np.testing.assert_allclose(ahead, capture.depths[row, line, column], rtol=1e-4)
        things = truth.things[row, line, column]
        moved = points.copy()
        for one in np.unique(things):
            thing, here_too = SCENE.things[one], things == one
            then = scene_oracle.canonical(thing, points[here_too], float(here.time))
            moved[here_too] = scene_oracle.observe(thing, then, float(there.time))
        known = np.ones(len(points), bool)
        known[lost] = False
        return Moved(moved, known)

    scored = random_renders(capture, np.random.default_rng(0))
    scored = scored._replace(depth=capture.depths[capture.heldout])
    flow = model_flow.heldout_flow(move, NOBODY, capture, scored)
    assert np.isnan(flow.predicted[lost]).all()
    known = np.isfinite(flow.predicted).all(axis=1)
    assert known.mean() > 0.95
    assert flow.moving.any()
    assert np.abs(flow.truth[flow.moving]).max() > 1
    np.testing.assert_allclose(flow.predicted[known], flow.truth[known], atol=0.02)


FIELD = RadianceScene(
    steps=40,
    template=TemplateSpec(
        position=EncodingSpec(2), direction=None, depth=2, width=8, skips=()
    ),
    sampling=SamplingSpec(6, 0, block=200),
    rays=64,
    warp=WarpSpec(
        position=EncodingSpec(2), depth=2, width=8, skips=(), anneal_steps=10
    ),
)
KINDS = {"gaussians": scenes.TINY_DEFORMABLE, "radiance": FIELD}


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    """A folder with a tiny scene and its truth."""
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    synthetic.write(SCENE, folder)
    return folder


def started(kind, folder):
    """A run that was not trained, its motion away from nothing."""
    config = RunConfig(preset="none", source=CaptureSource(capture=folder))
    run = runs.open_run(config, representations.named(kind), KINDS[kind])
    state = run.model.init(run.capture, jax.random.key(0))
    state = state._replace(step=jnp.asarray(20, jnp.int32))
    if kind == "gaussians":
        nets = jax.tree.map(lambda leaf: leaf + 0.02, state.params.nets)
        return run, state._replace(params=state.params._replace(nets=nets))
    warp = jax.tree.map(lambda leaf: leaf + 0.02, state.params["warp"])
    return run, state._replace(params=state.params | {"warp": warp})


@pytest.mark.full
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_is_held_against_the_truth_of_its_scene(kind, scene_folder, rng):
    run, state = started(kind, scene_folder)
    capture = run.capture
    scored = random_renders(capture, rng)
    renderer = evaluation.Renderer(run.model, run.capture.size)
    numbers, notes = quality.measure(run, state, renderer, scored)
    assert notes == []
    strain = {"tracks.strain"} if kind == "radiance" else set()
    assert set(numbers) == ALWAYS | MASKED | BASELINES | DEPTHS | TRUTH | strain

    truth = protocol.stored_truth(capture)
    known = protocol.ground_truth(capture, truth, 2, quality.TRACKS)
    followed = run.representation.scoring.follow(
        run.spec, run.metadata, state, capture, known
    )
    assert np.abs(followed.path - known.start_points[:, None]).max() > 1e-3
    seen = known.visible.copy()
    seen[:, known.start] = False
    for key, path in (
        ("tracks.epe", followed.path),
        ("tracks.static_epe", known.start_points[:, None]),
    ):
        away = np.linalg.norm(path - known.path, axis=-1)[seen]
        assert numbers[key] == pytest.approx(away.mean(), rel=1e-4)
    # The flow is that of the same motion: points of the start at the last time.
    move = run.representation.scoring.mover(run.spec, run.metadata)
    here, there = (
        evaluation.view_of(capture, int(known.track_rows[place]))
        for place in (known.start, -1)
    )
    moved = move(state, known.start_points, here, there)
    both = moved.converged & followed.converged[:, -1]
    assert both.any()
    np.testing.assert_allclose(moved.points[both], followed.path[both, -1], atol=1e-5)
    flow = model_flow.heldout_flow(move, state, capture, scored)
    away = np.linalg.norm(flow.predicted - flow.truth, axis=1)
    answered = np.isfinite(away)
    assert numbers["flow.epe"] == pytest.approx(away[answered].mean(), rel=1e-4)
    assert numbers["flow.missing"] == pytest.approx(1 - answered.mean(), abs=1e-6)


@pytest.mark.full
def test_a_scene_without_motion_or_truth_has_no_points_to_follow(
    scene_folder, rng, tmp_path
):
    run, state = started("gaussians", scene_folder)
    static = dataclasses.replace(KINDS["gaussians"], motion=None)
    kind = run.representation
    assert kind.scoring.mover(static, splat_scene.metadata_of(run.capture)) is None
    field = dataclasses.replace(FIELD, warp=None)
    assert (
        representations.named("radiance").scoring.mover(
            field, scene.metadata_of(run.capture, field)
        )
        is None
    )
    renderer = evaluation.Renderer(run.model, run.capture.size)
    scored = random_renders(run.capture, rng)
    elsewhere = dataclasses.replace(run.capture, path=None)
    numbers, notes = quality.measure(
        run._replace(observed=elsewhere), state, renderer, scored
    )
    assert notes == []
    assert set(numbers) == ALWAYS | MASKED | BASELINES | DEPTHS
    # A truth of another scene is no reason to lose what was trained.
    (tmp_path / synthetic.TRUTH_FILE).write_bytes(b"cut short")
    broken = dataclasses.replace(run.capture, path=tmp_path)
    numbers, notes = quality.measure(
        run._replace(observed=broken), state, renderer, scored
    )
    assert set(numbers) == ALWAYS | MASKED | BASELINES | DEPTHS
    assert "not a readable ground truth" in notes[0]
