"""Sonata and MoBa-GS as whole scenes: every part on at once."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import pytest
import rich.console

from gaussians_jax import scene
from gaussians_jax.effects import deformation
from gaussians_jax.spec import effects_of
from nerfies_jax import evaluation
from nerfies_jax.training import checkpoint, loop
from nerfies_jax.training.effects import FrameCondition
from tests import gradients, scenes
from tests.gaussians.shared import close, finite, same_bits

PAPERS = {"sonata": scenes.TINY_SONATA, "moba": scenes.TINY_MOBA}
QUIET = rich.console.Console(quiet=True)
by_paper = pytest.mark.parametrize("paper", PAPERS)


def metadata():
    return scene.metadata_of(scenes.tiny_capture())


@functools.cache
def made(paper):
    capture = scenes.tiny_capture()
    model = scene.build(PAPERS[paper], metadata())
    frames = evaluation.frames_of(capture, model.required_data)
    return model, frames


def start(paper):
    return made(paper)[0].init(scenes.tiny_capture(), jax.random.key(3))


def train(paper, state, steps, **settings):
    model, frames = made(paper)
    return loop.fit(model, state, frames, steps=steps, console=QUIET, **settings)


@functools.cache
def straight(paper):
    """Through the warm-up, two densifications, and MoBa's alternation."""
    return train(paper, start(paper), 21)


def psnr(paper, state):
    capture = scenes.tiny_capture()
    renderer = evaluation.Renderer(made(paper)[0], capture.size)
    return evaluation.score(renderer, state, capture, capture.train).psnr.mean()


@pytest.mark.slow
@by_paper
def test_a_run_with_every_part_learns_and_stays_finite(paper):
    model, result = made(paper)[0], straight(paper)
    assert result.stopped_by == "steps"
    names = {effect.name for effect in effects_of(PAPERS[paper], metadata())}
    silent = {"kan_motion", "motion_basis", "motion_growth"}  # add nothing to the loss
    seen = {key.partition("/")[0] for key in result.history.rows[-1]}
    assert names - silent <= seen
    # What the effects carry follows the rows.
    capacity = len(result.state.params.rows["splats"].mean)
    assert capacity != len(start(paper).params.rows["splats"].mean)
    carried = jax.tree.leaves(result.state.aux_state)
    assert {len(leaf) for leaf in carried} == {capacity}
    # The opacities are reset at step 20: the picture needs some hundred to come back.
    learnt = train(paper, result.state, 600).state
    assert finite(learnt.params)
    first, last = psnr(paper, start(paper)), psnr(paper, learnt)
    assert last > first + 3, (first, last)
    # Prepared once and drawn from that, as drawn whole.
    capture = scenes.tiny_capture()
    view = evaluation.view_of(capture, int(capture.heldout[0]))
    whole = jax.jit(model.render, static_argnums=2)
    expected = whole(learnt.params, view, capture.size, learnt.step)
    drawn = evaluation.Renderer(model, capture.size)(learnt, view)
    close(drawn, expected, 2e-5)


@pytest.mark.slow
@by_paper
def test_an_interrupted_run_ends_as_the_straight_one(paper, tmp_path):
    """Bit for bit, with what the effects carry (MoBa's holds infinities)."""
    model, _ = made(paper)
    with checkpoint.Checkpoints(tmp_path, model.spec) as checkpoints:
        train(paper, start(paper), 17, checkpoints=checkpoints)
    found = checkpoint.restore(tmp_path, start(paper), model.spec)
    again = train(paper, found.state, 21)
    same_bits(again.state._replace(key=0), straight(paper).state._replace(key=0))


@pytest.mark.slow
@by_paper
def test_the_loss_of_a_whole_step_has_the_right_slope(paper, float64):
    capture = scenes.tiny_capture()
    spec, known = PAPERS[paper], metadata()
    if paper == "moba":  # else no slope reaches the means through the networks
        motion = dataclasses.replace(spec.motion, detach=False)
        spec = dataclasses.replace(spec, motion=motion)
    effects = effects_of(spec, known)
    model, frames = scene.build(spec, known), evaluation.frames_of(capture, {"depths"})
    state = model.init(capture, jax.random.key(3))
    keys = iter(jax.random.split(jax.random.key(4), 100))

    def awake(leaf):
        """Heads start at zero; away from there every part of the field acts."""
        noise = 0.05 * jax.random.normal(next(keys), leaf.shape, jnp.float64)
        return leaf.astype(jnp.float64) + noise

    def wide(tree):
        return jax.tree.map(
            lambda leaf: leaf.astype(jnp.float64) if leaf.dtype.kind == "f" else leaf,
            tree,
        )

    params = wide(state.params)._replace(nets=jax.tree.map(awake, state.params.nets))
    view = wide(evaluation.view_of(capture, int(capture.train[2])))
    truth = wide(scene.observe(frames, 2, None))
    states = wide(scene.states_of(effects, params))
    step = jnp.asarray(20, jnp.int32)
    condition = FrameCondition(view.time, step=step, key=jax.random.key(5))

    def loss(params):
        moved = deformation.deform_in_training(
            effects, params, scene.splats.activate(params.rows["splats"]), condition
        )
        drawn = model.stages.draw(params, moved, view, (40, 30), step)
        seen = truth._replace(rendering=drawn)
        return scene.loss_of(spec, effects, params, seen, condition, states)[0]

    def of_rows(rows):
        return loss(params._replace(rows=rows))

    def of_nets(nets):
        return loss(params._replace(nets=nets))

    assert gradients.directional_error(of_nets, params.nets, step=1e-6) < 1e-5
    assert gradients.directional_error(of_rows, params.rows, step=1e-6) < 1e-4


def test_parts_that_need_others_are_refused():
    spec = dataclasses.replace(scenes.TINY_MOBA, motion=None)
    model = scene.build(spec, metadata())  # a trained scene may be drawn without
    with pytest.raises(ValueError, match="without a motion"):
        model.init(scenes.tiny_capture(), jax.random.key(0))
