"""Motions bound to a small scene, as `gaussians_jax.scene.scene.build` binds them."""

from gaussians_jax.core import components
from gaussians_jax.core.metadata import SceneMetadata


def motion(spec, steps=100, extent=1.0, frames=9, box=None):
    """The `Motion` of these settings in a scene of these sizes."""
    return spec.bind(steps, SceneMetadata(extent, (0.0, 0.0, 0.0), frames, box=box))


def record(spec, **sizes):
    """The internal record of the same motion."""
    return components.compile_motion(motion(spec, **sizes))
