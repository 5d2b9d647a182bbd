"""The face of both packages as a program uses it; mypy reads it, nothing runs it."""

import jax

import gaussians_jax as gj
import nerfies_jax as nj


def splats(folder: str) -> float:
    capture = nj.load_capture(folder, max_side=256, heldout=8)
    spec = gj.with_steps(gj.PRESETS["splats-deformable-small"], 500)
    model = gj.build(spec, gj.metadata_of(capture), effects=(own(),))
    state = model.init(capture, jax.random.key(0))
    frames = nj.frames_of(capture, model.required_data)
    result = nj.fit(model, state, frames, steps=spec.steps, seconds=60)
    renderer = nj.Renderer(model, capture.size)
    view = nj.view_of(capture, int(capture.heldout[0]))
    alpha = renderer(result.state, view).alpha
    scored = nj.score(renderer, result.state, capture, capture.heldout)
    gj.save("scene.ply", result.state.params.rows["splats"])
    return float(scored.psnr.mean()) + float(alpha.mean()) + result.seconds


def field(scene: str) -> int:
    capture = nj.built_in_scene(scene, seed=1)
    spec = nj.with_steps(nj.PRESETS["nerf-small"], 10)
    model = nj.build(spec, nj.metadata_of(capture, spec))
    return len(model.counts(model.init(capture, jax.random.key(0))))


def own() -> nj.Effect:
    return nj.Effect(
        "own",
        penalty=lambda params, context: {"one": nj.Term(jax.numpy.ones(()), None)},
    )


def drawn(gaussians: gj.Gaussians, colours: jax.Array) -> jax.Array:
    camera = nj.look_at((0, 0, -5), (0, 0, 0), (0, 1, 0), focal_px=150, size=(160, 120))
    return gj.render(gaussians, colours, camera, (160, 120)).rendering.colour
