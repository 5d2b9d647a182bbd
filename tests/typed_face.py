"""The face of both packages as a program uses it; mypy reads it, nothing runs it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import gaussians_jax as gj
import nerfies_jax as nj


def splats(folder: str) -> float:
    capture = nj.load_capture(folder, max_side=256, heldout=8)
    spec = gj.with_steps(gj.PRESETS["splats-deformable-small"], 500)
    spec = dataclasses.replace(spec, motion=Still(), regularizers=(Own(),))
    model = gj.build(spec, gj.metadata_of(capture))
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


@dataclasses.dataclass(frozen=True)
class Own:
    def loss(
        self, params: object, context: gj.losses.PenaltyContext
    ) -> dict[str, nj.Term]:
        return {"one": nj.Term(jnp.ones(()), None)}


@dataclasses.dataclass(frozen=True)
class Still:
    learning_rate: float = 1e-3

    def init(self, key: jax.Array, gaussians: gj.Splats) -> gj.motion.MotionParams:
        return gj.motion.MotionParams(jnp.zeros_like(gaussians.mean))

    def apply(
        self,
        params: gj.motion.MotionParams,
        cache: object,
        gaussians: gj.Gaussians,
        frame: nj.FrameCondition,
    ) -> gj.Gaussians:
        return gaussians._replace(mean=gaussians.mean + params.per_gaussian)


def render(gaussians: gj.Gaussians, colors: jax.Array) -> jax.Array:
    camera = nj.look_at((0, 0, -5), (0, 0, 0), (0, 1, 0), focal_px=150, size=(160, 120))
    return gj.render(gaussians, colors, camera, (160, 120)).rendering.color


def warped(twist: jax.Array, points: jax.Array) -> jax.Array:
    transform = nj.se3.multiply(nj.se3.exp(twist), nj.se3.identity())
    energy = nj.elastic_loss(lambda x: nj.se3.apply_twist(twist, x), points)
    turned = nj.so3.apply(nj.so3.exp(twist[:3]), points)
    camera = nj.Camera.from_K(np.eye(3), np.eye(4), 64, 48)
    pixels, depth = nj.project(camera, nj.se3.apply(transform, points))
    quaternion = nj.quaternion.exp(twist[:3])
    strain = nj.matrix3.log_energy(nj.quaternion.to_matrix(quaternion))
    return energy + strain + jnp.sum(turned) + jnp.sum(pixels) + jnp.sum(depth)


def rendered(key: jax.Array, x: jax.Array, rays: nj.Rays) -> nj.Rendered:
    spec = nj.KANSpec(in_features=3, hidden=(64,), out_features=4)
    layer = nj.kan.init(key, spec)
    window = nj.coarse_to_fine_window(4, 2.5)
    features = nj.positional_encoding(x, 4, window)
    t, points, _ = nj.sample_along_rays(
        key, rays.origin, rays.direction, 0.1, 4.0, 64, spacing="disparity"
    )
    values = nj.kan.apply(spec, layer, points) + jnp.sum(features)
    return nj.composite(values[..., 0], values[..., 1:], t)


def compared(image: jax.Array, truth: jax.Array, mask: jax.Array) -> jax.Array:
    loss = nj.losses.photometric(image, truth)
    scores = nj.psnr(image, truth) + nj.ssim(image, truth) + nj.ms_ssim(image, truth)
    masked = nj.masked_psnr(image, truth, mask) + nj.masked_ssim(image, truth, mask)
    return loss + scores + masked + nj.partial_ssim(image, truth, mask)
