"""Effects asked one by one from their own modules, and modules that do not answer."""

import contextlib
import dataclasses

import pytest

from gaussians_jax.core import components
from gaussians_jax.losses import acceleration, depth, neighbors, spectral
from gaussians_jax.losses import flow as motion_flow
from gaussians_jax.motion import (
    anchor_motion,
    anchors,
    carried,
    se3_bases,
    temporal_opacity,
    time_basis,
)
from gaussians_jax.motion import basis as motion_basis
from gaussians_jax.motion import embedding as embedding_motion
from gaussians_jax.motion import growth as motion_growth
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion import mlp as mlp_motion
from gaussians_jax.motion import nodes as node_motion
from gaussians_jax.motion import planes as plane_motion
from gaussians_jax.motion import polynomial as polynomial_motion
from gaussians_jax.motion import splines as spline_motion
from gaussians_jax.per_frame import appearance as gaussian_appearance
from gaussians_jax.per_frame import exposure, sky
from gaussians_jax.per_frame import poses as pose_refinement
from nerfies_jax.fields.effects import (
    ambient,
    appearance,
    background,
    elastic,
    moving_mask,
    ray_distortion,
    records,
    scene_flow,
    smoothness,
    surface,
    time_condition,
    time_warp,
    transient,
    warp,
)
from nerfies_jax.fields.effects.time_warp import TimeWarpSpec
from nerfies_jax.fields.spec import RadianceScene, templates_of

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
    "distortion": ray_distortion,
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
    "appearance": gaussian_appearance,
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
# Of the protocols that the parts of a scene fill.
METHODS = ("bind", "init", "precompute", "apply", "loss", "update", "events", "state")
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

    def conditioning(one):
        effects.append(records.compile_conditioning(one))

    def medium(one):
        effects.append(records.compile_medium(one, width))

    def regularizer(one):
        effects.append(records.compile_regularizer(one))

    if spec.appearance is not None:
        conditioning(spec.appearance)
    if spec.transient is not None:
        medium(spec.transient)
    if spec.time is not None:
        conditioning(spec.time)
    if spec.warp is not None:
        one = spec.warp
        if not isinstance(one, TimeWarpSpec):
            one = dataclasses.replace(one, guides=guides)
        effects.append(records.compile_warp(one))
    if spec.ambient is not None:
        bent = dataclasses.replace(spec.ambient, guides=guides)
        conditioning(bent.bind(spec.steps, metadata))
    if spec.elastic is not None:
        regularizer(spec.elastic)
    if spec.background is not None:
        regularizer(spec.background)
    if spec.scene_flow is not None:
        medium(scene_flow.Bound(spec.scene_flow, metadata.times))
    if spec.smoothness is not None:
        regularizer(smoothness.Bound(spec.smoothness, templates_of(spec)))
    if spec.distortion is not None:
        regularizer(spec.distortion)
    if spec.mask is not None:
        conditioning(spec.mask)
    if spec.surface is not None:
        widths = {name: one.width for name, one in templates_of(spec).items()}
        effects.append(surface.effect(spec.surface, widths))
    return tuple(effects)


def of_splats(spec, metadata):
    """The effects of a scene of Gaussians, asked one by one from their own modules."""
    effects, extent, frames = [], metadata.extent, metadata.frames
    motion = spec.motion
    if motion is not None:
        module = MOTION_MODULES[type(motion)]
        seen = (frames,) if type(motion) in BY_FRAMES else (extent,)
        if module is plane_motion:
            seen = (extent, metadata.box)
        own = module.Bound(motion, spec.steps, *seen)
        effects.append(components.compile_motion(own))
    if spec.temporal_opacity is not None:
        own = temporal_opacity.Bound(spec.temporal_opacity)
        effects.append(components.compile_motion(own))
    if spec.carried is not None:
        still = 0 if motion is None else motion.warm_up
        effects.append(carried.effect(spec.carried, spec.steps, still))
    if spec.acceleration is not None:
        own = acceleration.Bound(spec.acceleration, extent, frames)
        effects.append(components.compile_regularizer(own))
    if spec.neighbors is not None:
        own = neighbors.Bound(spec.neighbors, extent, effects[0].name)
        effects.append(components.compile_regularizer(own))
    if spec.spectral is not None:
        own = spec.spectral.bind(spec.steps, metadata)
        effects.append(components.compile_regularizer(own))
    if spec.depth is not None:
        effects.append(components.compile_regularizer(spec.depth))
    if spec.exposure is not None:
        own = exposure.Bound(spec.exposure, spec.steps, metadata.exposures)
        effects.append(components.compile_appearance(own))
    if spec.appearance is not None:
        own = gaussian_appearance.Bound(spec.appearance, spec.steps, metadata.exposures)
        effects.append(components.compile_gaussian_appearance(own))
    if spec.flow is not None:
        own = motion_flow.Bound(spec.flow, spec.raster)
        effects.append(components.compile_regularizer(own))
    if spec.poses is not None:
        seen = frames, metadata.depth
        own = pose_refinement.Bound(spec.poses, spec.steps, *seen)
        effects.append(components.compile_camera_optimizer(own))
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
    if spec.appearance is not None:
        gone.remove(exposure)  # its affine change of colors
    if getattr(spec.appearance, "sky", None) is None:
        gone.append(sky)
    return gone


@contextlib.contextmanager
def poisoned(modules):
    """Every function of these modules raises when it is called."""
    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            functions = functions_of(module)
            refuse(patch, module, functions)
            methods = [
                (kind, name)
                for kind in classes_of(module)
                for name in METHODS
                if name in vars(kind)
            ]
            assert functions or methods
            for kind, name in methods:
                refuse(patch, kind, [name])
        yield


def classes_of(module):
    """The classes that a module has of its own."""
    return [
        value
        for value in vars(module).values()
        if isinstance(value, type) and value.__module__ == module.__name__
    ]


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
