"""Files hold any Gaussians to within a step, and none that are not finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gaussians_jax import files, model_file, splats
from gaussians_jax.splats import Params, Splats
from tests.hard_cases.properties import same

pytestmark = pytest.mark.full
LARGEST = float(np.finfo(np.float32).max)


def float32s(shape, most=LARGEST):
    """Any float32 of at most this size, subnormal ones among them."""
    most = float(np.float32(most))
    return arrays.arrays(np.float32, shape, elements=st.floats(-most, most, width=32))


@st.composite
def rows(draw, far: float = LARGEST):
    """Three active rows of any harmonic degree and any finite values at all."""
    count, rest = 3, draw(st.sampled_from([0, 3, 8, 15]))
    quaternion = draw(float32s((count, 4)))
    logit = draw(float32s(count))
    logit = np.where(logit > splats.INACTIVE_LOGIT / 2, logit, 0)
    return Splats(
        mean=draw(float32s((count, 3), far)),
        log_scale=draw(float32s((count, 3))),
        quaternion=quaternion,
        opacity_logit=logit.astype(np.float32),
        sh_dc=draw(float32s((count, 1, 3))),
        sh_rest=draw(float32s((count, rest, 3))),
    )


def on_device(rows_):
    return jax.tree.map(jnp.asarray, rows_)


def opacity(logit):
    return 1 / (1 + np.exp(-np.clip(np.asarray(logit, np.float64), -700, 700)))


def same_turn(found, expected, least):
    """|cos| of half the angle between two arrays of quaternions is at least this."""
    found, expected = (np.asarray(q, np.float64) for q in (found, expected))
    length = np.linalg.norm(expected, axis=1, keepdims=True)
    unit = np.where(
        length > 0, expected / np.where(length > 0, length, 1), [1, 0, 0, 0]
    )
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    assert np.all(np.abs(np.sum(found * unit, axis=1)) >= least)


@pytest.mark.parametrize("version", [2, 3])
@given(rows_=rows(far=2047.9))
def test_spz_is_within_half_a_step_and_then_still(version, rows_, tmp_path):
    """For any finite values: what its bytes cannot hold is held at their ends."""
    path = tmp_path / "a.spz"
    files.save(path, on_device(rows_), spz_version=version)
    first = path.read_bytes()
    found = files.load(path).splats
    assert all(np.all(np.isfinite(leaf)) for leaf in found)
    step = 1.0001 / 4096 / 2
    np.testing.assert_allclose(found.mean, rows_.mean, atol=step, rtol=1e-7)
    np.testing.assert_allclose(
        found.log_scale, np.clip(rows_.log_scale, -10, 255 / 16 - 10), atol=0.5001 / 16
    )
    np.testing.assert_allclose(
        opacity(found.opacity_logit), opacity(rows_.opacity_logit), atol=0.751 / 255
    )
    # Version 2 has w from three bytes off by 1/255 each: its square is off by up to
    # 2 sqrt(3) / 255 = 1.36e-2, and where w = 0 the cosine by half of that.
    same_turn(found.quaternion, rows_.quaternion, 1 - (7e-3 if version == 2 else 1e-5))
    half = 127.5 / 255 / 0.15
    np.testing.assert_allclose(
        found.sh_dc, np.clip(rows_.sh_dc, -half, half), atol=0.5001 / 255 / 0.15
    )
    files.save(path, found, spz_version=version)
    again = files.load(path).splats
    for name in ("mean", "log_scale", "opacity_logit", "sh_dc", "sh_rest"):
        same(getattr(again, name), getattr(found, name))
    # The other sign is the same rotation: the same bytes. Version 2 stores x, y, z
    # of the half with w > 0, and where w = 0 it may be either.
    assume(version == 3 or np.all(rows_.quaternion[:, 0] != 0))
    turned = rows_._replace(quaternion=-rows_.quaternion)
    files.save(path, on_device(turned), spz_version=version)
    assert path.read_bytes() == first


@given(
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
    row=st.integers(0, 2),
    field=st.sampled_from(Splats._fields[:-1]),
    suffix=st.sampled_from(files.SUFFIXES),
    rows_=rows(far=1.0),
)
def test_what_is_not_finite_is_never_written(
    value, row, field, suffix, rows_, tmp_path
):
    """A NaN opacity, which is above no threshold, does not make a row inactive."""
    assume(field != "opacity_logit" or not value < 0)  # minus infinity does
    broken = {name: np.array(leaf) for name, leaf in rows_._asdict().items()}
    broken[field].reshape(3, -1)[row, -1] = value
    broken = on_device(Splats(**broken))
    path = tmp_path / f"a{suffix}"
    with pytest.raises(ValueError, match="not finite"):
        files.save(path, broken)
    assert not path.exists()
    with pytest.raises(ValueError, match="finite"):
        model_file.save(tmp_path / "model.npz", Params({"splats": broken}, {}), {})
    assert not (tmp_path / "model.npz").exists()


def plain(**fields):
    made = splats.from_points(np.eye(3), np.eye(3), degree=1)
    return made._replace(**{k: jnp.asarray(v, jnp.float32) for k, v in fields.items()})


@pytest.mark.parametrize("suffix", [*files.SUFFIXES, ".npz"])
def test_a_row_of_nan_opacity_is_refused_and_not_taken_for_inactive(suffix, tmp_path):
    broken = plain(opacity_logit=[0.0, np.nan, 0.0])
    path = tmp_path / f"a{suffix}"
    as_model = Params({"splats": broken}, {}), {}
    save, what = (
        (model_file.save, as_model) if suffix == ".npz" else (files.save, [broken])
    )
    with pytest.raises(ValueError, match="opacity_logit"):
        save(path, *what)
    assert not path.exists()


@pytest.mark.parametrize("version", [2, 3])
def test_the_largest_harmonics_are_held_and_do_not_overflow(version, tmp_path):
    """Above 2e36 scaling them in float32 overflowed, which warnings make an error."""
    size = np.array([LARGEST, -LARGEST, 1.0])
    rows_ = plain(sh_dc=np.tile(size, (3, 1, 1)), sh_rest=np.tile(size, (3, 3, 1)))
    files.save(tmp_path / "a.spz", rows_, spz_version=version)
    found = files.load(tmp_path / "a.spz").splats
    ends = np.array([127.5, -127.5, 0.15 * 255]) / 255 / 0.15
    np.testing.assert_allclose(found.sh_dc[0, 0], ends, atol=0.5001 / 255 / 0.15)
    assert np.all(np.abs(found.sh_rest[..., :2]) >= 1 - 8 / 128)
