"""Each array of a scene belongs to an effect that is there, at the presets' full sizes.

The expected arrays are counted out here, effect by effect, without the machinery that
puts scenes together; nothing is allocated or compiled for the fields.
"""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from gaussians_jax.losses import spectral
from gaussians_jax.motion import anchors, carried, se3_bases, time_basis
from gaussians_jax.motion import basis as motion_basis
from gaussians_jax.motion import embedding as embedding_motion
from gaussians_jax.motion import kan as kan_motion
from gaussians_jax.motion import mlp as mlp_motion
from gaussians_jax.motion import nodes as node_motion
from gaussians_jax.motion import planes as plane_motion
from gaussians_jax.motion.anchors import AnchorMotionSpec
from gaussians_jax.motion.basis import BasisMotionSpec
from gaussians_jax.motion.embedding import EmbeddingMotionSpec
from gaussians_jax.motion.kan import KanMotionSpec
from gaussians_jax.motion.mlp import MotionSpec
from gaussians_jax.motion.nodes import NodeMotionSpec
from gaussians_jax.motion.planes import PlaneMotionSpec
from gaussians_jax.motion.polynomial import PolynomialMotionSpec
from gaussians_jax.motion.se3_bases import SE3BasesSpec
from gaussians_jax.motion.splines import SplineMotionSpec
from gaussians_jax.motion.time_basis import TimeBasisSpec
from gaussians_jax.per_frame import appearance as gaussian_appearance
from gaussians_jax.scene import presets as splat_presets
from gaussians_jax.scene import scene as splat_scene
from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import field as fields
from nerfies_jax.fields import template
from nerfies_jax.fields.effects import (
    ambient,
    moving_mask,
    scene_flow,
    surface,
    time_warp,
    transient,
    warp,
)
from nerfies_jax.fields.effects.time_warp import TimeWarpSpec
from nerfies_jax.nn import mlp
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.nn.voxels import VoxelGridSpec
from nerfies_jax.scene import presets as field_presets
from tests import bare_scenes, scenes

QUICK = ("nerf-w", "hypernerf")
TIMESTAMPS, EXPOSURES = 5, 3
METADATA = SceneMetadata(
    near=1.0,
    far=3.0,
    center=(0.0, 0.0, 0.0),
    scale=1.0,
    background=None,
    times=tuple(t / (TIMESTAMPS - 1) for t in range(TIMESTAMPS)),
    exposures=tuple((row, row, 0.0) for row in range(EXPOSURES)),
)
# Of each motion its name, whether Gaussians have parameters of it, and the function
# that makes its networks.
MOTIONS = {
    MotionSpec: ("mlp_motion", False, mlp_motion.init),
    KanMotionSpec: ("kan_motion", True, kan_motion.init),
    BasisMotionSpec: ("motion_basis", False, motion_basis.init),
    EmbeddingMotionSpec: ("embedding_motion", True, embedding_motion.init),
    SE3BasesSpec: ("se3_bases", True, se3_bases.init),
    TimeBasisSpec: ("time_basis", True, time_basis.init),
    NodeMotionSpec: ("node_motion", False, node_motion.init),
    AnchorMotionSpec: ("anchor_motion", True, anchors.init),
    PlaneMotionSpec: ("plane_motion", False, plane_motion.init),
    PolynomialMotionSpec: ("polynomial_motion", True, None),
    SplineMotionSpec: ("spline_motion", True, None),
}
BY_FRAMES = (kan_motion.init, embedding_motion.init, anchors.init)


def shapes(tree):
    """Shape and type of every array, by its path."""
    return {
        jax.tree_util.keystr(path): (leaf.shape, leaf.dtype)
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def random_params(init, *args):
    """What an `init` would return, without drawing it."""
    return jax.eval_shape(lambda key: init(key, *args), jax.random.key(0))


def counted_out(spec):
    """The parameters that a field should have."""
    key, width = jax.random.key(0), spec.template.width
    lifted = beside = 0
    tables, own = {}, {}
    guides = () if spec.mask is None else ("mask",)
    if spec.appearance is not None:
        beside += spec.appearance.width
        tables["appearance"] = (EXPOSURES, spec.appearance.width)
    if spec.transient is not None:
        tables["transient"] = (EXPOSURES, spec.transient.code_width)
        own["transient"] = transient.init(spec.transient, key, width)
    if spec.time is not None:
        lifted += 1 + 2 * spec.time.encoding.bands  # of the time itself
    if isinstance(spec.warp, TimeWarpSpec):
        own["warp"] = time_warp.init(spec.warp, key)
        lifted += 3 * (1 + 2 * spec.warp.position.bands) + spec.warp.embedding
    elif spec.warp is not None:
        bent = dataclasses.replace(spec.warp, guides=guides)
        own["warp"] = warp.init(bent, key)
        if spec.warp.condition == "code":
            tables["motion"] = (TIMESTAMPS, spec.warp.code_width)
    if spec.ambient is not None:
        bent = dataclasses.replace(spec.ambient, guides=guides)
        own["ambient"] = ambient.init(bent, key)
        tables["motion"] = (TIMESTAMPS, spec.ambient.code_width)
        lifted += 2 * spec.ambient.encoding.bands * spec.ambient.dims
    if spec.scene_flow is not None:
        own["scene_flow"] = scene_flow.init(spec.scene_flow, key, width)
    nets = {"fine": spec.template}
    if spec.sampling.fine and not spec.sampling.shared:
        nets["coarse"] = spec.coarse or spec.template
    if spec.mask is not None:
        own["mask"] = moving_mask.init(spec.mask, key)
        tables[spec.mask.table] = (TIMESTAMPS, spec.mask.code_width)
    if spec.surface is not None:
        own["surface"] = surface.init({n: one.width for n, one in nets.items()}, key)
        for one in (spec.surface.position, spec.surface.normal):
            beside += 3 * (1 + 2 * one.bands)
    own["template"] = {}
    for name, one in nets.items():
        point = lifted
        if isinstance(one.position, HashGridSpec):
            point += one.position.levels * one.position.features
        elif isinstance(one.position, VoxelGridSpec):
            waves = 1 + 2 * one.position.bands
            point += len(one.position.strides) * one.position.features * waves
        else:
            point += 3 * (1 + 2 * one.position.bands)
        view = 0 if one.direction is None else 3 * (1 + 2 * one.direction.bands)
        own["template"][name] = template.init(one, key, point, view + beside)
    own["codes"] = {name: jnp.zeros(shape) for name, shape in tables.items()}
    return own


def removed_from(spec):
    """The preset itself, and without each of what it has."""
    return [spec, *(bare_scenes.without(spec, p) for p in bare_scenes.parts_of(spec))]


@pytest.mark.parametrize(
    "preset",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.full)
        for name in field_presets.PRESETS
    ],
)
def test_a_field_has_the_arrays_of_what_it_has_and_no_others(preset):
    whole = bare_scenes.from_rest(field_presets.PRESETS[preset])
    for spec in removed_from(whole):
        field = fields.field(spec, METADATA)
        arrays = jax.eval_shape(field.init, jax.random.key(0))
        expected = jax.eval_shape(lambda spec=spec: counted_out(spec))
        assert shapes(arrays) == shapes(expected)


@pytest.mark.parametrize(
    "preset",
    [
        pytest.param(
            name, marks=() if name == "splats-deformable" else pytest.mark.full
        )
        for name in splat_presets.PRESETS
    ],
)
def test_splats_have_the_arrays_of_what_they_have_and_no_others(preset):
    capture = scenes.tiny_capture()
    metadata = splat_scene.metadata_of(capture)
    for spec in removed_from(bare_scenes.tiny_splats(preset)):
        state = splat_scene.build(spec, metadata).init(capture, jax.random.key(0))
        motion, key, nets = spec.motion, jax.random.key(0), {}
        rows, states = {"splats"}, set()
        if motion is not None:
            name, has_rows, init = MOTIONS[type(motion)]
            if has_rows:
                rows.add(name)
            if init is not None:
                frames = (metadata.frames,) if init in BY_FRAMES else ()
                nets[name] = init(key, motion, *frames)
            if name == "node_motion":
                states.add(name)
        if spec.temporal_opacity is not None:
            rows.add("temporal_opacity")
        if spec.carried is not None:
            rows.add("carried")
            turns = carried.network_spec(spec.carried.turns)
            nets["carried"] = mlp.init(turns, key)
        if spec.spectral is not None:
            nets["spectral"] = spectral.init(spec.spectral)
        if spec.neighbors is not None:
            states.add("neighbors")
        if spec.appearance is not None:
            rows.add("appearance")
            own = gaussian_appearance.Bound(spec.appearance, 1, metadata.exposures)
            nets["appearance"] = own.init(key, state.params.rows["splats"]).shared
        assert set(state.params.rows) == rows
        assert shapes(state.params.nets) == shapes(nets)
        assert set(state.aux_state.effects) == states
        # A count and two moments for each array that is trained, and nothing else.
        trained = len(jax.tree.leaves(state.params))
        assert len(jax.tree.leaves(state.optimizer)) == 3 * trained
