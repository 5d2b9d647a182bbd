"""Every public function of both packages refuses or converts what does not fit.

Nothing is compiled: arguments are checked while a call is traced. With x64 on and
under strict promotion. `docs/conventions.md` has the table of what is converted.
"""

import inspect
import pathlib
import types
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gaussians_jax as gj
import nerfies_jax as nj

pytestmark = pytest.mark.slow

CONVENTIONS = pathlib.Path(__file__).resolve().parents[1] / "docs" / "conventions.md"
CAMERA = nj.look_at((0, 0, -4), (0, 0, 0), (0, 1, 0), 9.0, (8, 8))
KAN = nj.KANSpec(in_features=3, hidden=(4,), out_features=2)
INTEGERS = ("uint8", "uint16", "int32", "int64")


class Case(NamedTuple):
    """A call of one function with keyword arrays of these shapes."""

    call: Callable
    shapes: dict[str, tuple[int, ...]]
    half: str = "rounded"  # or "float32", "refused"
    images: tuple[str, ...] = ()
    more: bool = False  # an argument may have more leading axes than the others
    fewer: bool = False  # or fewer axes


def broadcast(function, *shapes, half="rounded", **static):
    """Of a function whose leading axes broadcast; arrays by its first parameters."""
    names = [name for name in inspect.signature(function).parameters][: len(shapes)]
    call = lambda **arrays: function(**arrays, **static)  # noqa: E731
    return Case(call, dict(zip(names, shapes, strict=True)), half, more=True)


def exact(function, *, half="rounded", images=(), more=False, fewer=False, **rest):
    """Of a function that takes these shapes alone; the rest is static."""
    shapes = {k: v for k, v in rest.items() if isinstance(v, tuple)}
    static = {k: v for k, v in rest.items() if k not in shapes}
    call = lambda **arrays: function(**arrays, **static)  # noqa: E731
    return Case(call, shapes, half, images, more, fewer)


def two_images(function, mask=False, **rest):
    first, second = list(inspect.signature(function).parameters)[:2]
    static = {"mask": np.ones((12, 12), bool)} if mask else {}
    shapes = {first: (12, 12, 3), second: (12, 12, 3)}
    return exact(
        function, **shapes, **static, half="float32", images=(first, second), **rest
    )


def gaussians(mean, quaternion, scale, opacity):
    return gj.Gaussians(mean, quaternion, scale, opacity)


ROWS = {"mean": (5, 3), "quaternion": (5, 4), "scale": (5, 3), "opacity": (5,)}
V, Q, M = (3,), (4,), (3, 3)
so3, se3, quaternion, matrix3 = nj.so3, nj.se3, nj.quaternion, nj.matrix3
losses, kan = nj.losses, nj.kan
KAN_SHAPES = jax.eval_shape(lambda key: kan.init(key, KAN), jax.random.key(0))
PARAMS = jax.tree.map(lambda leaf: np.ones(leaf.shape, leaf.dtype), KAN_SHAPES)

CASES = {
    "nj.so3.exp": broadcast(so3.exp, V),
    "nj.so3.log": broadcast(so3.log, M),
    "nj.so3.apply": broadcast(so3.apply, M, V),
    "nj.so3.multiply": broadcast(so3.multiply, M, M),
    "nj.so3.inverse": broadcast(so3.inverse, M),
    "nj.so3.left_jacobian": broadcast(so3.left_jacobian, V),
    "nj.so3.inverse_left_jacobian": broadcast(so3.inverse_left_jacobian, V),
    "nj.so3.hat": broadcast(so3.hat, V),
    "nj.se3.exp": broadcast(se3.exp, (6,)),
    "nj.se3.log": broadcast(se3.log, (4, 4)),
    "nj.se3.apply": broadcast(se3.apply, (4, 4), V),
    "nj.se3.apply_twist": broadcast(se3.apply_twist, (6,), V),
    "nj.se3.displacement": broadcast(se3.displacement, (6,), V),
    "nj.se3.multiply": broadcast(se3.multiply, (4, 4), (4, 4)),
    "nj.se3.inverse": broadcast(se3.inverse, (4, 4)),
    "nj.se3.left_jacobian": broadcast(se3.left_jacobian, (6,)),
    "nj.se3.from_rotation_translation": broadcast(se3.from_rotation_translation, M, V),
    "nj.quaternion.normalize": broadcast(quaternion.normalize, Q),
    "nj.quaternion.multiply": broadcast(quaternion.multiply, Q, Q),
    "nj.quaternion.conjugate": broadcast(quaternion.conjugate, Q),
    "nj.quaternion.rotate": broadcast(quaternion.rotate, Q, V),
    "nj.quaternion.to_matrix": broadcast(quaternion.to_matrix, Q),
    "nj.quaternion.from_matrix": broadcast(quaternion.from_matrix, M),
    "nj.quaternion.exp": broadcast(quaternion.exp, V),
    "nj.quaternion.log": broadcast(quaternion.log, Q),
    "nj.quaternion.slerp": broadcast(quaternion.slerp, Q, Q, ()),
    "nj.matrix3.log_energy": broadcast(matrix3.log_energy, M),
    "nj.matrix3.signed_log_energy": broadcast(matrix3.signed_log_energy, M),
    "nj.matrix3.displacement_log_energy": broadcast(matrix3.displacement_log_energy, M),
    "nj.matrix3.singular_values": broadcast(matrix3.singular_values, M),
    "nj.matrix3.svd": broadcast(matrix3.svd, M),
    "nj.project": Case(
        lambda point: nj.project(CAMERA, point), {"point": V}, "refused", more=True
    ),
    "nj.unproject": Case(
        lambda pixel: nj.unproject(CAMERA, pixel), {"pixel": (2,)}, "refused", more=True
    ),
    "nj.positional_encoding": broadcast(
        nj.positional_encoding, (3,), num_frequencies=4
    ),
    "nj.coarse_to_fine_window": Case(
        lambda alpha: nj.coarse_to_fine_window(4, alpha), {"alpha": ()}, more=True
    ),
    "nj.kan.apply": exact(
        lambda x: kan.apply(KAN, PARAMS, x), x=(5, 3), half="refused", more=True
    ),
    "nj.kan.apply_heads": exact(
        lambda x: kan.apply_heads(KAN, PARAMS, x),
        x=(5, 3),
        half="refused",
        more=True,
    ),
    "nj.kan.standardize": exact(
        kan.standardize, features=(5, 3), more=True, fewer=True
    ),
    "nj.kan.hold": exact(
        lambda x: kan.hold(x, (-1.0, 1.0), 0.3), x=(5, 3), more=True, fewer=True
    ),
    "nj.sample_along_rays": exact(
        nj.sample_along_rays,
        key=None,
        origins=(5, 3),
        directions=(5, 3),
        near=(),
        far=(),
        num_samples=4,
        half="float32",
    ),
    "nj.composite": broadcast(nj.composite, (6,), (6, 4), (6,), (4,)),
    "nj.elastic_loss": exact(
        lambda points, weights: nj.elastic_loss(lambda x: 2 * x, points, weights),
        points=(5, 3),
        weights=(5,),
        half="refused",
    ),
    "nj.psnr": two_images(nj.psnr, more=True),
    "nj.ssim": two_images(nj.ssim, more=True),
    "nj.ms_ssim": two_images(nj.ms_ssim, more=True, scales=1),
    "nj.masked_psnr": two_images(nj.masked_psnr, True, more=True),
    "nj.masked_ssim": two_images(nj.masked_ssim, True, more=True),
    "nj.partial_ssim": two_images(nj.partial_ssim, True, more=True),
    "nj.losses.l1": two_images(losses.l1),
    "nj.losses.mse": two_images(losses.mse),
    "nj.losses.ssim": two_images(losses.ssim),
    "nj.losses.dssim_map": two_images(losses.dssim_map),
    "nj.losses.photometric": two_images(losses.photometric),
    "nj.losses.psnr": exact(
        losses.psnr, mse=(5,), half="float32", more=True, fewer=True
    ),
    "nj.losses.masked_mean": exact(
        losses.masked_mean,
        values=(5, 3),
        valid=None,
        half="float32",
        more=True,
        fewer=True,
    ),
    **{
        f"nj.losses.{function.__name__}": exact(
            function, residual_sq=(5,), width=0.1, more=True, fewer=True
        )
        for function in (losses.charbonnier, losses.huber, losses.geman_mcclure)
    },
    "gj.project": Case(
        lambda **rows: gj.project(gaussians(**rows), CAMERA, (8, 8), gj.RasterSpec()),
        ROWS,
        "refused",
    ),
    "gj.render": Case(
        lambda colors, background, **rows: gj.render(
            gaussians(**rows), colors, CAMERA, (8, 8), background=background
        ),
        {**ROWS, "colors": (5, 3), "background": (3,)},
        "refused",
    ),
    "gj.rasterize": Case(
        lambda values, **rows: gj.rasterize(
            gj.project(gaussians(**rows), CAMERA, (8, 8), gj.RasterSpec()),
            values,
            (8, 8),
            gj.RasterSpec(),
        ),
        {**ROWS, "values": (5, 4)},
        "refused",
    ),
    "gj.rasterization": exact(
        gj.rasterization,
        means=(5, 3),
        quats=(5, 4),
        scales=(5, 3),
        opacities=(5,),
        colors=(5, 4),
        viewmats=(1, 4, 4),
        Ks=(1, 3, 3),
        width=8,
        height=8,
        half="refused",
    ),
}
# Names without a case, and why.
OTHERS = {
    "types": "nj.Camera nj.Rays nj.RaySamples nj.Rendered nj.KANSpec nj.RadianceScene "
    "nj.FrameCondition nj.Term nj.Renderer gj.RasterSpec "
    "gj.RasterizationInfo gj.TrackFit gj.Scene gj.SceneMetadata gj.Gaussians "
    "gj.Params gj.Splats gj.Appearance gj.CameraOptimizer "
    "gj.GaussianAppearance "
    "nj.kan.KANSpec nj.kan.KAN nj.kan.KANLayer nj.kan.Kernels",
    "settings": "nj.PRESETS nj.with_steps gj.PRESETS gj.with_steps nj.checked "
    "nj.losses.check_geman_mcclure nj.kan.spacing nj.kan.centers nj.kan.width "
    "nj.kan.init nj.so3.identity nj.se3.identity nj.quaternion.identity",
    "models and captures": "nj.build nj.metadata_of gj.build gj.metadata_of nj.fit "
    "nj.built_in_scene nj.load_capture nj.saved_run nj.frames_of nj.view_of nj.score",
    "modules of other libraries": "nj.adapters.linen nj.adapters.nnx "
    "nj.adapters.equinox",
    "files": "gj.load gj.save",
    "host, refused in their own tests": "nj.look_at gj.from_points nj.pixel_rays "
    "gj.fit_tracks gj.strategy.select",
    "parts of kan.apply": "nj.kan.first_layer_part nj.kan.after_first_layer",
    "as the image metrics": "nj.losses.middle_level",
}


def names_of(face, prefix):
    for name in face.__all__:
        value = getattr(face, name)
        if not isinstance(value, types.ModuleType):
            yield f"{prefix}.{name}"
            continue
        for inner, function in vars(value).items():
            own = getattr(inspect.unwrap(function), "__module__", "") == value.__name__
            if inspect.isfunction(function) and own and not inner.startswith("_"):
                yield f"{prefix}.{name}.{inner}"


def traced(case, dtypes=None, shapes=None):
    """Types of the result; arrays are float32 unless `dtypes` says otherwise."""
    shapes = case.shapes | (shapes or {})
    arrays = {
        name: jax.ShapeDtypeStruct(shape, (dtypes or {}).get(name, "float32"))
        for name, shape in shapes.items()
    }
    with jax.enable_x64(True):
        return jax.eval_shape(lambda arrays: case.call(**arrays), arrays)


def floats(results):
    leaves = jax.tree.leaves(results)
    return {
        leaf.dtype.name for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)
    }


def refusal(case, **changes):
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        traced(case, **changes)
    return str(caught.value)


def test_every_public_name_has_a_case_or_a_reason():
    public = {*names_of(nj, "nj"), *names_of(gj, "gj")}
    excused = {name for names in OTHERS.values() for name in names.split()}
    types_of_kan = {name for name in excused if name.startswith("nj.kan.K")}
    assert public == set(CASES) | (excused - types_of_kan)
    assert not excused & set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_float32_stays_float32_where_x64_is_on(name):
    assert floats(traced(CASES[name])) == {"float32"}


@pytest.mark.parametrize("name", CASES)
def test_integers_are_refused_by_name_or_converted_as_images(name):
    case = CASES[name]
    for argument in case.shapes:
        # All kinds of the first argument and of images; the others are read alike.
        first = argument in (next(iter(case.shapes)), *case.images)
        for kind in INTEGERS if first else INTEGERS[:1]:
            if argument in case.images and kind.startswith("uint"):
                assert floats(traced(case, {argument: kind})) == {"float32"}
                continue
            message = refusal(case, dtypes={argument: kind})
            assert argument in message
            assert kind in message


@pytest.mark.parametrize("channels", [1, 4])
def test_colors_of_gray_and_of_rgba_never_become_depth(channels):
    message = refusal(CASES["gj.render"], shapes={"colors": (5, channels)})
    assert f"`colors` has shape [5, {channels}], expected [gaussians, 3]" in message


@pytest.mark.parametrize(
    "kind", ["bfloat16", pytest.param("float16", marks=pytest.mark.full)]
)
@pytest.mark.parametrize("name", CASES)
def test_half_types_are_refused_by_name_or_widened_as_documented(name, kind):
    case = CASES[name]
    every = dict.fromkeys(case.shapes, kind)
    if case.half == "refused":
        assert kind in refusal(case, dtypes=every)
        return
    widened = kind if case.half == "rounded" else "float32"
    assert floats(traced(case, every)) == {widened}


@pytest.mark.full
@pytest.mark.parametrize("name", CASES)
def test_one_half_type_beside_float32_gives_either(name):
    case = CASES[name]
    for argument in case.shapes:
        if case.half != "refused":
            assert floats(traced(case, {argument: "bfloat16"})) <= {
                "float32",
                "bfloat16",
            }


@pytest.mark.parametrize("name", CASES)
def test_wrong_ranks_are_refused_by_name_or_broadcast(name):
    case = CASES[name]
    for argument, shape in case.shapes.items():
        more = {argument: (2, *shape)}
        if not case.more and argument not in ("near", "far", "background"):
            assert argument in refusal(case, shapes=more)
        if shape and not case.fewer:
            assert argument in refusal(case, shapes={argument: shape[:-1]})
    if case.more and not name.startswith("nj.losses"):
        results = jax.tree.leaves(traced(case, None, more))
        assert {leaf.shape[0] for leaf in results} == {2}


def test_the_table_of_the_documentation_is_that_of_the_cases():
    text = CONVENTIONS.read_text()
    for half in ("rounded", "float32", "refused"):
        line = next(
            line for line in text.splitlines() if line.startswith(f"| {half} |")
        )
        listed = {name.strip("` ") for name in line.split("|")[3].split(",")}
        covered = set()
        for name, case in CASES.items():
            if case.half == half:
                entry = {name, name.rpartition(".")[0] + ".*"} & listed
                assert entry, name
                covered |= entry
        assert covered == listed
