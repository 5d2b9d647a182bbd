"""What no network computes keeps its digits, whatever JAX's default of products is.

A device may round the factors of a matrix product (a TPU to 8 bits, a GPU to 11), and
so may JAX's own switch. In a network that is a price; of places, orders and measures it
is an error.
"""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from gaussians_jax.motion import se3_bases
from gaussians_jax.motion.se3_bases import Bases, Poses
from gaussians_jax.scene import presets as splat_presets
from gaussians_jax.splatting import projection, raster
from gaussians_jax.splatting.raster_spec import GSPLAT
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.scene import presets as field_presets
from nerfies_jax.training import matrix_flops
from tests import bare_scenes
from tests.gaussians.shared import put, same_bits, some_gaussians
from tests.test_effect_cost import started_field, started_splats

ROOT = pathlib.Path(__file__).resolve().parents[1]
ROOMS = (ROOT / "nerfies_jax", ROOT / "gaussians_jax")
# Where networks multiply.
NETWORKS = {
    *(f"nerfies_jax/nn/{name}.py" for name in ("dense", "kan", "mlp")),
    "nerfies_jax/fields/template.py",
    "nerfies_jax/fields/effects/warp.py",
}
FIRST_LAYERS = {
    ("gaussians_jax/motion/embedding.py", "prepare"),
    ("gaussians_jax/motion/embedding.py", "deform"),
    ("gaussians_jax/motion/basis.py", "prepare_point"),
}


def equations(jaxpr):
    """All operations of a program and of those within it."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in matrix_flops._inner(equation.params):
            yield from equations(inner)


def place_of(equation):
    """File and function of the library that asked for an operation."""
    for frame in equation.source_info.traceback.frames:
        path = pathlib.Path(frame.file_name)
        ours = any(path.is_relative_to(room) for room in ROOMS)  # not a .venv in ROOT
        if ours and path.stem != "precision":
            return path.relative_to(ROOT).as_posix(), frame.function_name.split(".")[0]
    return "", ""


def rounded_products(program):
    """Where a program leaves the digits of a product to the default."""
    return {
        place_of(equation)
        for equation in equations(program.jaxpr)
        if equation.primitive.name in ("dot_general", "conv_general_dilated")
        if equation.params["precision"] != (lax.Precision.HIGHEST,) * 2
    }


IN_CORE = ("splats-tracked-small", "nerf-w-small", "nsff-small")
# Other presets have all of their parts: static scenes are in those with an effect, the
# motion by a network is in D-MiSo's, and hash grids are in NeRF-W's.
CONTAINED = {"nerf-small", "splats-static-small", "splats-deformable-small"}
CONTAINED |= {f"{name}-grid-small" for name in ("nerf", "d-nerf", "nerfies")}
CONTAINED |= {"hypernerf-grid-small"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in IN_CORE else pytest.mark.full)
        for name in (*splat_presets.PRESETS, *field_presets.PRESETS)
        if name.endswith("-small") and name not in CONTAINED
    ],
)
def test_only_networks_leave_the_digits_of_products_to_the_default(name):
    """Traced, not compiled: shapes and dtypes of the whole step are kept as well."""
    if name in splat_presets.PRESETS:
        started = started_splats(bare_scenes.from_rest(bare_scenes.tiny_splats(name)))
        state = started.state
    else:
        started = started_field(bare_scenes.from_rest(bare_scenes.tiny_field(name)))
        state = jax.eval_shape(started.init, jax.random.key(0))
    trace = jax.make_jaxpr(started.model.step, return_shape=True)
    program, (after, metrics) = trace(state, started.frames)
    others = {place for place in rounded_products(program) if place[0] not in NETWORKS}
    assert others <= FIRST_LAYERS
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for before, now in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        assert (before.shape, before.dtype) == (now.shape, now.dtype)
    assert {"loss", "mse"} <= set(metrics)


def test_a_product_of_places_is_found():
    def turned(matrix, point):
        return matrix @ point

    assert rounded_products(jax.make_jaxpr(turned)(jnp.eye(3), jnp.ones(3))) != set()


def test_an_image_is_the_same_under_every_default():
    gaussians = some_gaussians(400, "float32")
    camera = cameras.pinhole(np.eye(3), np.array([0, 0, -4.0]), 40.0, (32, 24))

    def render(gaussians):
        seen = projection.project(gaussians, camera, (32, 24), GSPLAT)
        return raster.rasterize(seen, gaussians.scale, (32, 24), GSPLAT)

    images = []
    for default in (None, "BF16_BF16_F32"):
        with jax.default_matmul_precision(default):
            images.append(jax.jit(render)(gaussians))
    same_bits(*images)


def moved_by_bases(dtype):
    """Where points some four units from the origin go with turns of half a radian."""
    rng = np.random.default_rng(0)
    render = [size * rng.normal(size=(4, 5, 3)) for size in (0.5, 0.2)]
    none = np.zeros((4, 0, 3))
    bases = Bases(Poses(*render), Poses(none, none), 2 + rng.normal(size=(4, 3)))
    logits = 8 * np.eye(5)[rng.integers(1, 5, 500)]
    gaussians = some_gaussians(500, dtype)
    gaussians = put(gaussians._replace(mean=np.asarray(gaussians.mean) + 2), dtype)

    @jax.jit
    def moved(bases, logits, time):
        return se3_bases.deform(se3_bases.at_time(bases, time), logits, gaussians).mean

    return np.asarray(moved(*put((bases, logits, 0.37), dtype)), np.float64)


@pytest.mark.full
@pytest.mark.parametrize(("bits", "off"), [(8, 6e-3), (11, 1.6e-3), (24, 6e-7)])
def test_rounded_factors_misplace_points(bits, off, monkeypatch):
    """As devices round them: the rows of docs/numerics.md, within a third."""
    with jax.enable_x64(True):
        exact = moved_by_bases("float64")

    def rounding(product):
        def of_rounded(*inputs):
            return product(
                *(
                    one
                    if isinstance(one, str)
                    else lax.reduce_precision(one, 8, bits - 1)
                    for one in inputs
                )
            )

        return of_rounded

    for name in ("exact_einsum", "exact_product"):
        monkeypatch.setattr(se3_bases, name, rounding(getattr(se3_bases, name)))
    error = np.abs(moved_by_bases("float32") - exact).max()
    assert error == pytest.approx(off, rel=1 / 3)
