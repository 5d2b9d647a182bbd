"""Effects asked one by one from their own modules, and modules that do not answer."""

import contextlib
import dataclasses

import pytest

from gaussians_jax.effects import (
    acceleration,
    anchor_motion,
    anchors,
    carried,
    depth,
    embedding_motion,
    exposure,
    kan_motion,
    mlp_motion,
    motion_basis,
    motion_flow,
    motion_growth,
    neighbors,
    node_motion,
    plane_motion,
    polynomial_motion,
    pose_refinement,
    se3_bases,
    spectral,
    spline_motion,
    temporal_opacity,
    time_basis,
)
from nerfies_jax.effects import (
    ambient,
    appearance,
    background,
    elastic,
    moving_mask,
    scene_flow,
    smoothness,
    surface,
    time_condition,
    time_warp,
    transient,
    warp,
)
from nerfies_jax.effects.time_warp import TimeWarpSpec
from nerfies_jax.spec import RadianceScene, templates_of

FIELD_MODULES = {
    "appearance": appearance,
    "transient": transient,
    "time": time_condition,
    "warp": warp,
    "ambient": ambient,
    "elastic": elastic,
    "background": background,
    "scene_flow": scene_flow,
    "smoothness": smoothness,
    "mask": moving_mask,
    "surface": surface,
}
SPLAT_MODULES = {
    "temporal_opacity": temporal_opacity,
    "carried": carried,
    "acceleration": acceleration,
    "neighbors": neighbors,
    "motion_growth": motion_growth,
    "spectral": spectral,
    "depth": depth,
    "exposure": exposure,
    "flow": motion_flow,
    "poses": pose_refinement,
}
MOTION_MODULES = {
    mlp_motion.MotionSpec: mlp_motion,
    kan_motion.KanMotionSpec: kan_motion,
    motion_basis.BasisMotionSpec: motion_basis,
    se3_bases.SE3BasesSpec: se3_bases,
    time_basis.TimeBasisSpec: time_basis,
    polynomial_motion.PolynomialMotionSpec: polynomial_motion,
    spline_motion.SplineMotionSpec: spline_motion,
    plane_motion.PlaneMotionSpec: plane_motion,
    embedding_motion.EmbeddingMotionSpec: embedding_motion,
    node_motion.NodeMotionSpec: node_motion,
    anchors.AnchorMotionSpec: anchor_motion,
}
BY_FRAMES = {  # the others ask for the scene's extent
    mlp_motion.MotionSpec,
    kan_motion.KanMotionSpec,
    motion_basis.BasisMotionSpec,
    embedding_motion.EmbeddingMotionSpec,
    anchors.AnchorMotionSpec,
}


def of_field(spec, metadata):
    """The effects of a field, asked one by one from their own modules."""
    width = spec.template.width
    effects = []
    guides = () if spec.mask is None else ("mask",)
    if spec.appearance is not None:
        effects.append(appearance.effect(spec.appearance))
    if spec.transient is not None:
        effects.append(transient.effect(spec.transient, width))
    if spec.time is not None:
        effects.append(time_condition.effect(spec.time))
    if isinstance(spec.warp, TimeWarpSpec):
        effects.append(time_warp.effect(spec.warp))
    elif spec.warp is not None:
        effects.append(warp.effect(dataclasses.replace(spec.warp, guides=guides)))
    if spec.ambient is not None:
        bent = dataclasses.replace(spec.ambient, guides=guides)
        effects.append(ambient.effect(bent))
    if spec.elastic is not None:
        effects.append(elastic.effect(spec.elastic))
    if spec.background is not None:
        effects.append(background.effect(spec.background))
    if spec.scene_flow is not None:
        effects.append(scene_flow.effect(spec.scene_flow, metadata.times, width))
    if spec.smoothness is not None:
        effects.append(smoothness.effect(spec.smoothness, templates_of(spec)))
    if spec.mask is not None:
        effects.append(moving_mask.effect(spec.mask))
    if spec.surface is not None:
        widths = {name: one.width for name, one in templates_of(spec).items()}
        effects.append(surface.effect(spec.surface, widths))
    return tuple(effects)


def of_splats(spec, metadata):
    """The effects of a scene of Gaussians, asked one by one from their own modules."""
    effects, extent, frames = [], metadata.extent, metadata.frames
    motion = spec.motion
    if motion is not None:
        seen = (frames,) if type(motion) in BY_FRAMES else (extent,)
        if isinstance(motion, plane_motion.PlaneMotionSpec):
            seen = (extent, metadata.box)
        module = MOTION_MODULES[type(motion)]
        effects.append(module.effect(motion, spec.steps, *seen))
    if spec.temporal_opacity is not None:
        effects.append(temporal_opacity.effect(spec.temporal_opacity))
    if spec.carried is not None:
        still = 0 if motion is None else motion.warm_up
        effects.append(carried.effect(spec.carried, spec.steps, still))
    if spec.acceleration is not None:
        effects.append(acceleration.effect(spec.acceleration, extent, frames))
    if spec.neighbors is not None:
        effects.append(neighbors.effect(spec.neighbors, extent, effects[0].name))
    if spec.motion_growth is not None:
        effects.append(motion_growth.effect(spec.motion_growth, extent))
    if spec.spectral is not None:
        effects.append(spectral.effect(spec.spectral, spec.steps))
    if spec.depth is not None:
        effects.append(depth.effect(spec.depth))
    if spec.exposure is not None:
        places = metadata.exposures
        effects.append(exposure.effect(spec.exposure, spec.steps, places))
    if spec.flow is not None:
        effects.append(motion_flow.effect(spec.flow, spec.raster))
    if spec.poses is not None:
        seen = frames, metadata.depth
        effects.append(pose_refinement.effect(spec.poses, spec.steps, *seen))
    return tuple(effects)


def absent_modules(spec):
    """Modules whose effect is not in the scene, and that no other one builds on."""
    if isinstance(spec, RadianceScene):
        gone = [m for name, m in FIELD_MODULES.items() if getattr(spec, name) is None]
        if not isinstance(spec.warp, TimeWarpSpec):
            return [*gone, time_warp]
        return [*gone, warp]
    gone = [m for name, m in SPLAT_MODULES.items() if getattr(spec, name) is None]
    motion = spec.motion
    gone += [m for kind, m in MOTION_MODULES.items() if not isinstance(motion, kind)]
    if isinstance(motion, motion_basis.BasisMotionSpec):
        gone.remove(mlp_motion)
    if isinstance(motion, embedding_motion.EmbeddingMotionSpec):
        gone.remove(kan_motion)
    if isinstance(motion, anchors.AnchorMotionSpec):
        gone.remove(kan_motion)
        gone.remove(carried)
    if getattr(motion, "fading", None) is not None:
        gone.remove(temporal_opacity)
    return gone


@contextlib.contextmanager
def poisoned(modules):
    """Every function of these modules raises when it is called."""
    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            functions = functions_of(module)
            assert "effect" in functions
            refuse(patch, module, functions)
        yield


def functions_of(module):
    """The names of the functions that a module has of its own."""
    return [
        name
        for name, value in vars(module).items()
        if callable(value) and not isinstance(value, type)
        if getattr(value, "__module__", None) == module.__name__
    ]


def refuse(patch, module, functions):
    """Let these functions of a module raise when they are called."""

    def refused(*_, **__):
        raise AssertionError(f"{module.__name__} is off and was called")

    for name in functions:
        patch.setattr(module, name, refused)


def file_of(module):
    return "/".join(module.__file__.replace("\\", "/").split("/")[-3:])
