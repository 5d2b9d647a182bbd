"""What every public function of numbers promises, made from its annotations.

Inputs are drawn from the jaxtyping annotation of each argument; arguments that are no
arrays stand in `SETTINGS`, and a function that is in neither fails here until it is
named. With x64 on and under strict promotion: what goes in as float32 comes out as
float32, and value and gradients are finite at zero, near the smallest normal number and
as far up as `REACH` says. The values have oracles in the tests of each module.
"""

import functools
import importlib
import inspect
import typing
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.fields import template
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.nn import grids, kan, mlp, planes
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.nn.grids import HashGridSpec
from nerfies_jax.nn.kan import KANSpec
from nerfies_jax.nn.mlp import HeadSpec, MLPSpec
from nerfies_jax.nn.planes import PlanesSpec
from nerfies_jax.nn.voxels import VoxelGridSpec

MODULES = (
    *(f"nerfies_jax.geometry.{name}" for name in ("lie", "quaternion", "stumpff")),
    *(f"nerfies_jax.geometry.{name}" for name in ("matrix3", "camera", "distortion")),
    *("nerfies_jax.geometry.rays", "nerfies_jax.geometry.precision"),
    *(f"nerfies_jax.nn.{name}" for name in ("codes", "encoding", "kan", "mlp")),
    *("nerfies_jax.nn.grids", "nerfies_jax.nn.planes", "nerfies_jax.nn.voxels"),
    "nerfies_jax.nn.entropy",
    *(f"nerfies_jax.fields.{name}" for name in ("compositing", "sampling")),
    *("nerfies_jax.fields.template", "nerfies_jax.training.losses"),
    *(
        "gaussians_jax.splatting.projection",
        "gaussians_jax.core.splats",
        "gaussians_jax.splatting.harmonics",
    ),
    *("gaussians_jax.splatting.blending", "gaussians_jax.core.faces"),
)
# No function of arrays alone, or held where the reason says.
EXCUSED = {
    **dict.fromkeys(
        ["camera.resize", "camera.crop", "camera.pinhole", "camera.look_at"], "host"
    ),
    **dict.fromkeys(["camera.stack", "camera.take", "camera.validate"], "host"),
    **dict.fromkeys(
        ["rays.across_ray", "codes.check_ids", "splats.rows_to_write"], "host"
    ),
    "splats.active_count": "host",
    "codes.place_of": "looks up in tuples or arrays, in test_scene.py",
    "losses.check_geman_mcclure": "settings",
    "distortion.to_bernstein": "host",
    **dict.fromkeys(["splats.from_points", "splats.neighbor_distance"], "host"),
    **dict.fromkeys(["splats.random_in_views", "splats.scene_extent"], "host"),
    **dict.fromkeys(["splats.capacity_for", "harmonics.degree_of"], "sizes"),
    **dict.fromkeys(["kan.spacing", "kan.width", "kan.centers"], "settings"),
    "template.trunk_spec": "settings",
    **dict.fromkeys(["quaternion.identity", "rays.pixel_centers"], "constants"),
    **dict.fromkeys(["codes.init", "kan.init", "mlp.init", "mlp.init_layer"], "draws"),
    **dict.fromkeys(["template.init", "grids.init", "planes.init"], "draws"),
    "voxels.init": "zeros",
    **dict.fromkeys(["template.raw_density", "template.add_color"], "template.apply"),
    "template.color_offset": "template.apply",
    "grids.variation_at_random": "draws",
    **dict.fromkeys(["precision.at_least_float32", "precision.refuse_half"], "types"),
    "splats.refuse_half": "types",
    **dict.fromkeys(["precision.exact_product", "precision.exact_einsum"], "NumPy's"),
    **dict.fromkeys(["splats.take_rows", "splats.pad_rows"], "moves rows of any tree"),
    **dict.fromkeys(["blending.blend", "blending.blend_gradient"], "test_raster.py"),
    **dict.fromkeys(["kan.first_layer_part", "kan.after_first_layer"], "in kan.apply"),
    "kan.apply_heads": "in kan.apply",
    **dict.fromkeys(["losses.ssim", "losses.photometric"], "means of dssim_map"),
}

_MLP = MLPSpec(3, 2, 4, (("y", HeadSpec(2)),), skips=(1,))
_KAN = KANSpec(3, (4,), out_features=2, kernels=4)
_TEMPLATE = TemplateSpec(
    EncodingSpec(2), EncodingSpec(1), depth=2, width=4, skips=(1,), color_width=4
)


def _network(make):
    """Parameters of its shapes, in the precision asked for."""

    def random_params(dtype):
        shapes = jax.eval_shape(lambda key: make(key, dtype), jax.random.key(0))
        rng = np.random.default_rng(0)
        return jax.tree.map(lambda x: 0.3 * rng.normal(size=x.shape), shapes)

    return lambda dtype: jax.tree.map(lambda x: x.astype(dtype), random_params(dtype))


_GRID = HashGridSpec(levels=2, coarsest=1, finest=2, rows=20)
_PLANES = PlanesSpec(vertices=3, multiples=(1, 2), timestamps=3, features=2)


def _levels(dtype):
    """Planes, each leaf an array of JAX, as the check of tuples wants it."""
    levels = _network(functools.partial(planes.init, _PLANES))(dtype)
    return jax.tree.map(jnp.asarray, levels)


SETTINGS = {
    "planes.encode": {"spec": _PLANES, "levels": _levels},
    "planes.space_features": {"spec": _PLANES, "levels": _levels},
    "planes.at_time": {"levels": _levels},
    "planes.time_features": {
        "spec": _PLANES,
        "lines": lambda dtype: jax.tree.map(
            lambda plane: plane[0],
            tuple(level.time for level in _levels(dtype)),
        ),
    },
    "planes.features": {"spec": _PLANES},
    "grids.encode": {
        "spec": _GRID,
        # A tuple of arrays is looked into, and NumPy's are none of JAX's.
        "tables": lambda dtype: tuple(
            map(jnp.asarray, _network(functools.partial(grids.init, _GRID))(dtype))
        ),
    },
    "grids.unit_place": {"half_side": 1.0, "is_contracted": True},
    "voxels.encode": {
        "spec": VoxelGridSpec(cells=2, features=2, strides=(2, 1), bands=1),
        "tables": lambda dtype: (
            jnp.asarray(np.random.default_rng(0).normal(size=(27, 2)), dtype),
        ),
    },
    "grids.level_features": {"cells": 2},
    "grids.vertex_row": {"cells": 2, "rows": 20},
    "grids.total_variation": {"cells": 2},
    "template.encode": {
        "spec": _TEMPLATE,
        "params": _network(
            lambda key, dtype: template.init(_TEMPLATE, key, 15, 3, dtype)
        ),
        "step": None,
    },
    "stumpff.stumpff": {"order": 2},
    "rays.pixel_rays": {"size": (3, 2)},
    "precision.near_one": {"axis": -1},
    "encoding.encode": {"spec": EncodingSpec(4, times_pi=True), "window": None},
    "encoding.anneal": {"bands": 4},
    "encoding.positional_encoding": {"num_frequencies": 4},
    "encoding.coarse_to_fine_window": {"num_frequencies": 4},
    "kan.apply": {
        "spec": _KAN,
        "params": _network(lambda key, dtype: kan.init(key, _KAN, dtype)),
    },
    "kan.hold": {"grid": (-1.0, 1.0), "margin": 0.3},
    **{
        f"mlp.{name}": {
            "spec": _MLP,
            "params": _network(functools.partial(mlp.init, _MLP)),
        }
        for name in ("apply", "hidden_features", "with_known")
    },
    "mlp.affine": {
        "layer": _network(lambda key, dtype: mlp.init_layer(key, 3, 2, "he", dtype))
    },
    "template.apply": {
        "spec": _TEMPLATE,
        "params": _network(
            lambda key, dtype: template.init(_TEMPLATE, key, 15, 3, dtype)
        ),
        "density_noise": None,
    },
    "compositing.intervals": {"last": 1e10},
    **{
        f"sampling.{name}": {"key": None, "count": 4}
        for name in ("stratified", "sample_pdf", "refine", "sample_around")
    },
    "sampling.among": {"key": None, "count": 4, "empty": 0.05},
    **{
        f"losses.{name}": {"width": 0.1}
        for name in ("charbonnier", "huber", "geman_mcclure")
    },
    "projection.project": {"size": (8, 8), "spec": GSPLAT},
    "splats.active_degree": {"interval": 10, "degree": 3},
    "harmonics.basis": {"degree": 3},
    "entropy.noisy": {"key": lambda dtype: jax.random.key(0)},
}

# Lengths of axes; all others are 3. Variadic axes are one axis of 2, but for
# a batch, which callers make with `vmap`.
SIZES = {
    **dict.fromkeys(["height", "width"], 12),
    **dict.fromkeys(["code", "features", "coefficients"], 4),
    **dict.fromkeys(["samples", "bins"], 6),
    **{"edges": 7, "dim": 3, "rest": 3, "channels": 2, "part": 2, "known": 1},
}
SIZES_OF = {
    "template.apply": {"inputs": 15, "condition": 3},
    "kan.standardize": {"features": 5},
    "grids.level_features": {"rows": 27},
    "grids.total_variation": {"rows": 27},
    "planes.encode": {"dimensions": 4},
}


def _rotation(rng, shape):
    turned, _ = np.linalg.qr(rng.normal(size=shape))
    return turned * np.linalg.det(turned)[..., None, None]


def _unit(rng, shape):
    vectors = rng.normal(size=shape)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _positive(rng, shape):
    return rng.uniform(0.1, 1, shape)


def _sorted(rng, shape):
    return np.sort(rng.uniform(1, 4, shape), axis=-1)


def _near(value, spread=0.1):
    return lambda rng, shape: value + spread * rng.uniform(-1, 1, shape)


# Arguments that are not any number, by name: how they are drawn, and whether they may
# be scaled.
DRAWS = {
    **dict.fromkeys(["rotation", "camera_from_world"], (_rotation, False)),
    **dict.fromkeys(["direction", "start", "end"], (_unit, False)),
    **dict.fromkeys(["optical_depth", "residual_sq", "mse", "size"], (_positive, True)),
    "angle_sq": (_positive, True),
    **dict.fromkeys(["weight", "weights", "scale"], (_positive, True)),
    **dict.fromkeys(["opacity", "time", "progress"], (_positive, False)),
    **dict.fromkeys(["distances", "edges", "coarse", "fine"], (_sorted, False)),
    "near": (_near(1.0), False),
    "far": (_near(4.0), False),
    "focal_px": (_near(10.0), False),
    "pixel_aspect": (_near(1.0), False),
    **dict.fromkeys(["skew_px", "radial", "tangential"], (_near(0.0, 0.01), False)),
    **dict.fromkeys(["fraction", "place", "step"], (_positive, False)),
}


class Function(typing.NamedTuple):
    name: str  # "lie.exp_so3"
    call: typing.Callable
    annotations: dict[str, typing.Any]  # of the arguments that are drawn


def _public():
    for path in MODULES:
        module = importlib.import_module(path)
        for name, function in vars(module).items():
            if name.startswith("_") or not inspect.isfunction(function):
                continue
            if inspect.unwrap(function).__module__ == path:
                yield f"{path.rsplit('.', 1)[1]}.{name}", function


def _drawn(name, function):
    settings = SETTINGS.get(name, {})
    return {
        key: parameter.annotation
        for key, parameter in inspect.signature(function).parameters.items()
        if key not in settings and parameter.default is inspect.Parameter.empty
    }


FUNCTIONS = {
    name: Function(name, function, _drawn(name, function))
    for name, function in _public()
    if name not in EXCUSED
}


def _draw(name, key, annotation, rng, sizes):
    """One input, and whether each of its leaves may be scaled."""
    if key == "fisheye":  # in `test_fisheye.py`; it replaces the other coefficients
        return None, None
    if hasattr(annotation, "_fields"):
        hints = typing.get_type_hints(annotation)
        both = [_draw(name, k, hints[k], rng, sizes) for k in annotation._fields]
        return tuple(annotation(*leaves) for leaves in zip(*both, strict=True))
    options = [a for a in typing.get_args(annotation) if a is not type(None)]
    if not hasattr(annotation, "dim_str") and options:
        return _draw(name, key, options[0], rng, sizes)
    if not hasattr(annotation, "dim_str"):
        raise TypeError(
            f"{name}: {key} is no array ({annotation}); give it in SETTINGS, or name "
            "the function in EXCUSED"
        )
    shape = tuple(
        int(axis) if axis.isdigit() else sizes.get(axis, 2 if axis[0] == "*" else 3)
        for axis in annotation.dim_str.split()
        if axis != "*batch"
    )
    if "float32" in annotation.dtypes:
        draw, free = DRAWS.get(key, (lambda rng, shape: rng.normal(size=shape), True))
        return draw(rng, shape), free
    if "bool" in annotation.dtypes:
        return rng.uniform(size=shape) < 0.7, False
    return rng.integers(0, 2, shape).astype(np.int32), False


# How far up inputs may go, as a power of the largest number; others may be any. A
# quarter of it is taken, since sums of a few of the largest overflow.
_TURNS = ["transform_point", "displacement", "rotate_point", "exp_so3", "exp_se3"]
_JACOBIANS = ["left_jacobian", "left_jacobian_se3"]
REACH = {
    # squares and products with the axis: documented to 1e19 for the angle alone
    **{f"lie.{name}": 0.25 for name in [*_TURNS, *_JACOBIANS]},
    "camera.move": 0.25,
    "lie.inverse_left_jacobian": 0.0,  # singular from 2π on
    "lie.log_se3": 0.5,
    # products of two inputs
    **dict.fromkeys(["quaternion.exp", "quaternion.multiply", "splats.rotate"], 0.45),
    **dict.fromkeys(["compositing.composite", "compositing.expected_distance"], 0.45),
    **dict.fromkeys(["losses.mse", "grids.total_variation"], 0.45),
    "distortion.distort": 0.1,  # seventh powers of the radius, and their slopes
    "losses.dssim_map": 0.2,  # variances over squared means
    **dict.fromkeys(["planes.total_variation", "planes.time_smoothness"], 0.45),
    "planes.features": 0.45,
    "entropy.bits": 0.45,  # over a deviation as small as e^-12
    **dict.fromkeys(["entropy.quantize", "faces.gaussians"], 0.9),  # in steps; lengths
    # sums of more than four, or multiples
    **dict.fromkeys(["codes.blend", "encoding.encode", "losses.l1"], 0.9),
    "encoding.positional_encoding": 0.9,
    **dict.fromkeys(["planes.bilinear", "planes.linear", "planes.l1_time_planes"], 0.9),
    "rays.intersect_aabb": 0.9,  # distances are quotients by a slant
    **dict.fromkeys(["template.encode", "template.exponential"], 0.8),
}
# The dearest to compile: in core only their types are looked at.
DEAR = {
    *(f"lie.{name}" for name in ("exp_se3", "log_se3", "left_jacobian_se3", "log_so3")),
    *("lie.transform_point", "quaternion.slerp", "template.apply", "kan.apply"),
    *("matrix3.displacement_log_energy", "matrix3.signed_log_energy"),
    "camera.move",
    *("camera.unproject", "rays.pixel_ray", "rays.pixel_rays", "projection.project"),
    *("distortion.undistort", "losses.dssim_map", "faces.gaussians"),
    *("planes.encode", "planes.space_features", "matrix3.log_energy"),
}
# 9 s to compile for 24, with the same rewriting of the program.
QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}

USUAL = 2  # rows drawn; then one of zeros, one of the smallest, one of the largest


def _rows(function, dtype):
    """The drawn arguments and those given, [rows, ...] each."""
    limits = np.finfo(dtype)
    most = float(limits.max) ** REACH.get(function.name, 1.0) / 4
    factors = [1, 1, 0, 10 * float(limits.tiny), most]
    sizes = SIZES | SIZES_OF.get(function.name, {})
    arguments = {}
    for key, annotation in function.annotations.items():
        parts = []
        for row, factor in enumerate(factors):
            seed = zlib.crc32(f"{function.name} {key} {min(row, USUAL)}".encode())
            rng = np.random.default_rng(seed)
            leaves, free = _draw(function.name, key, annotation, rng, sizes)
            parts.append(jax.tree.map(functools.partial(_scaled, factor), leaves, free))
        arguments[key] = jax.tree.map(
            lambda *leaves: _typed(np.stack(leaves), dtype), *parts
        )
    return arguments


def _scaled(factor, leaf, free):
    return np.asarray(leaf * factor if free else leaf)


def _typed(leaf, dtype):
    return leaf.astype(dtype) if np.issubdtype(leaf.dtype, np.floating) else leaf


def _given(name, dtype):
    settings = SETTINGS.get(name, {})
    return {k: v(jnp.dtype(dtype)) if callable(v) else v for k, v in settings.items()}


def _is_float(leaf):
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _value_and_slopes(function, settings, arguments):
    """Float results, others, and slopes of the sum of the first in all floats."""
    leaves, tree = jax.tree.flatten(arguments)

    def of_floats(floats):
        given_floats = iter(floats)
        filled = [next(given_floats) if _is_float(x) else x for x in leaves]
        results = jax.tree.leaves(_called(function, tree.unflatten(filled) | settings))
        return (
            [x for x in results if _is_float(x)],
            [x for x in results if not _is_float(x)],
        )

    floats = [x for x in leaves if _is_float(x)]
    if function is FUNCTIONS["matrix3.svd"].call:  # refuses to be differentiated
        return *of_floats(floats), []
    values, pull, others = jax.vjp(of_floats, floats, has_aux=True)
    # Not all ones: what is standardized has no slope along them.
    along = [np.cos(np.arange(x.size)).reshape(x.shape).astype(x.dtype) for x in values]
    return values, others, pull(along)[0]


def _called(function, arguments):
    """By position, in the order of the signature: `at_least_float32` takes no names."""
    names = [key for key in inspect.signature(function).parameters if key in arguments]
    return function(*(arguments[key] for key in names))


def _compiled(name, dtype):
    """The program of the floats, other results and gradients, and its rows."""
    function, settings = FUNCTIONS[name], _given(name, dtype)
    one = functools.partial(_value_and_slopes, function.call, settings)
    return jax.jit(jax.vmap(one), compiler_options=QUICK), _rows(function, dtype)


def _check_finite(values, others, grads, dtype):
    for leaf in (*values, *grads):
        assert leaf.dtype == dtype
    assert all(np.isfinite(leaf).all() for leaf in (*values, *others, *grads))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_float32_stays_float32_and_finite_where_x64_is_on(name):
    with jax.enable_x64(True):
        every, rows = _compiled(name, "float32")
        if name in DEAR:
            values, _, grads = jax.eval_shape(every, rows)
            assert {leaf.dtype.name for leaf in (*values, *grads)} == {"float32"}
        else:
            _check_finite(*every(rows), jnp.float32)


@pytest.mark.full
@pytest.mark.parametrize("name", sorted(DEAR))
def test_float32_of_what_takes_long_to_compile_is_finite(name):
    with jax.enable_x64(True):
        every, rows = _compiled(name, "float32")
        _check_finite(*every(rows), jnp.float32)


@pytest.mark.full
@pytest.mark.parametrize("name", FUNCTIONS)
def test_float64_is_finite_everywhere(name):
    with jax.enable_x64(True):
        every, rows = _compiled(name, "float64")
        _check_finite(*every(rows), jnp.float64)


@functools.partial(jax.jit, compiler_options=QUICK)
def _every_rotation_and_strain(arguments):
    return {
        name: _called(FUNCTIONS[name].call, settings | SETTINGS.get(name, {}))
        for name, settings in arguments.items()
    }


@pytest.mark.full
@pytest.mark.parametrize("kind", ["bfloat16", "float16"])
def test_rotations_and_strains_of_half_precision_are_rounded_once(kind):
    """Computed in float32 from the same inputs; in bfloat16 a screw is 3e-2 off."""
    rooms = {"lie", "quaternion", "stumpff", "matrix3"}
    names = [name for name in FUNCTIONS if name.split(".")[0] in rooms]
    inputs = {name: _rows(FUNCTIONS[name], "float32") for name in names}
    half = jax.tree.map(lambda rows: rows[0].astype(jnp.dtype(kind)), inputs)
    rounded = _every_rotation_and_strain(half)
    exact = _every_rotation_and_strain(jax.tree.map(np.float32, half))
    half_ulp = float(jnp.finfo(kind).eps) / 2
    for one, other in zip(*map(jax.tree.leaves, (rounded, exact)), strict=True):
        assert one.dtype == kind
        off = np.abs(np.asarray(one, np.float32) - np.asarray(other))
        # float16's smallest numbers are 6e-8 apart
        assert np.all(off <= 1.001 * half_ulp * np.abs(other) + 6e-8)


def test_no_name_is_excused_or_set_in_vain():
    every = {name for name, _ in _public()}
    assert set(EXCUSED) <= every
    assert {*SETTINGS, *SIZES_OF, *REACH, *DEAR} <= set(FUNCTIONS)
