"""Gaussian files: round trips, other tools' files, and everything that can be wrong."""

import gzip
import os
import struct

import jax
import numpy as np
import plyfile
import pytest

from gaussians_jax.core import splats
from gaussians_jax.core.splats import INACTIVE_LOGIT, Params, Splats
from gaussians_jax.io import files, model_file, spz
from gaussians_jax.splatting import harmonics
from tests.gaussians.shared import full, put, rotations, same_bits


def some_splats(count=20, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    rest = (degree + 1) ** 2 - 1
    quaternion = rng.normal(size=(count, 4))
    leaves = (
        rng.uniform(-3, 3, (count, 3)),
        rng.uniform(-6, 1, (count, 3)),
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        rng.normal(size=count) * 2,
        rng.normal(size=(count, 1, 3)),
        rng.uniform(-0.9, 0.9, (count, rest, 3)),
    )
    return put(Splats(*leaves), "float32")


def edited(rows, **leaves):
    """The same rows with some of a leaf's numbers replaced: `leaf=(where, number)`."""
    for name, (where, number) in leaves.items():
        leaf = np.array(getattr(rows, name))
        leaf[where] = number
        rows = rows._replace(**{name: put(leaf)})
    return rows


def opacities(*several):
    return [1 / (1 + np.exp(-np.asarray(x.opacity_logit, float))) for x in several]


def same_rotation(a, b):
    """1 - |cos| of half the angle between two arrays of quaternions."""
    return 1 - np.cos((rotations(a).inv() * rotations(b)).magnitude() / 2)


@pytest.mark.parametrize("degree", [0, 3, *full(1, 2)])
def test_ply_keeps_every_bit(degree, tmp_path):
    rows = some_splats(degree=degree)
    assert files.save(tmp_path / "a.ply", rows) == 20
    loaded = files.load(tmp_path / "a.ply")
    assert loaded.dropped == 0
    assert loaded.notes == ()
    same_bits(loaded.splats, rows)


def test_ply_has_the_properties_that_viewers_read(tmp_path):
    rows = some_splats(degree=3)
    files.save(tmp_path / "a.ply", rows)
    ply = plyfile.PlyData.read(tmp_path / "a.ply")
    vertex = ply["vertex"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)] + ["opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [prop.name for prop in vertex.properties] == names
    assert not ply.text
    assert ply.byte_order == "<"
    # All of red comes first: coefficient 2 (of 15) of green is property 15 + 2.
    rows = jax.tree.map(np.asarray, rows)
    np.testing.assert_array_equal(vertex["f_rest_17"], rows.sh_rest[:, 2, 1])
    np.testing.assert_array_equal(vertex["rot_0"], rows.quaternion[:, 0])


@pytest.mark.parametrize(
    "name", ["gaussian_splatting_web_pc_short_100.ply", "splatapult_axes_16.ply"]
)
def test_a_file_of_another_tool_comes_back_bit_for_bit(name, data_dir, tmp_path):
    theirs = data_dir / "splat_files" / name
    loaded = files.load(theirs)
    assert loaded.splats.sh_rest.shape[1:] == (15, 3)
    files.save(tmp_path / "again.ply", loaded.splats)
    same_bits(files.load(tmp_path / "again.ply").splats, loaded.splats)
    # One of the two files has bytes behind its last row, and the reader says so.
    data = (tmp_path / "again.ply").read_bytes()
    assert theirs.read_bytes()[: len(data)] == data
    behind = theirs.stat().st_size - len(data)
    assert loaded.notes == (
        (f"ignored: {behind} bytes after the last row",) if behind else ()
    )


def test_inactive_rows_stay_behind(tmp_path):
    rows = edited(some_splats(), opacity_logit=(slice(3, None), INACTIVE_LOGIT))
    assert files.save(tmp_path / "a.ply", rows) == 3
    assert files.load(tmp_path / "a.ply").splats.mean.shape == (3, 3)
    with pytest.raises(ValueError, match="none of the 20 Gaussians is active"):
        files.save(
            tmp_path / "b.ply", edited(rows, opacity_logit=(..., INACTIVE_LOGIT))
        )
    assert not (tmp_path / "b.ply").exists()


def write_ply(path, columns, **kind):
    """A good file with some of its columns replaced; None takes a column out."""
    files.save(path, some_splats())
    table = plyfile.PlyData.read(path)["vertex"].data
    columns_of = {name: table[name] for name in table.dtype.names} | columns
    columns_of = {
        name: np.asarray(x) for name, x in columns_of.items() if x is not None
    }
    data = np.empty(20, [(name, x.dtype.str) for name, x in columns_of.items()])
    for name, x in columns_of.items():
        data[name] = x
    plyfile.PlyData([plyfile.PlyElement.describe(data, "vertex")], **kind).write(path)


@pytest.mark.parametrize("kind", [{"byte_order": ">"}, {"text": True}])
def test_the_other_two_byte_orders_and_float64_are_read(kind, tmp_path):
    path, places = tmp_path / "a.ply", np.linspace(0, 1, 20)
    more = {"nx": None, "ny": None, "nz": None, "label": places}
    write_ply(path, {"x": places} | more, **kind)
    loaded = files.load(path)
    mean, *_, rest = map(np.asarray, loaded.splats)
    np.testing.assert_allclose(mean[:, 0], places, rtol=1e-6)
    np.testing.assert_allclose(rest, some_splats().sh_rest, rtol=1e-6)
    assert loaded.notes == ("ignored: label",)


def test_doubles_that_float32_would_move_are_refused(tmp_path):
    write_ply(tmp_path / "a.ply", {"x": 4_649_776.3 + np.linspace(0, 1, 20)})
    with pytest.raises(ValueError, match=r"float32 would round .* subtract an"):
        files.load(tmp_path / "a.ply")


@pytest.mark.parametrize("value", [np.nan, *full(np.inf)])
def test_a_broken_row_is_named_or_dropped(value, tmp_path):
    path = tmp_path / "a.ply"
    scale = np.zeros(20, np.float32)
    scale[[7, 9]] = value
    write_ply(path, {"scale_1": scale})
    with pytest.raises(ValueError, match=r"a\.ply: row 7 has a log_scale that is no"):
        files.load(path)
    loaded = files.load(path, drop_broken=True)
    assert loaded.dropped == 2
    assert loaded.splats.mean.shape == (18, 3)
    rows = some_splats()
    with pytest.raises(ValueError, match=r"row 4 has a mean .* not written"):
        files.save(path, edited(rows, mean=((4, 2), value)))
    assert files.load(path, drop_broken=True).dropped == 2  # the old file still stands


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rot_3": None}, "missing properties: rot_3"),
        ({"f_rest_44": None}, "44 properties f_rest"),
        ({"f_dc_0": None}, "holds points or a mesh, not Gaussians"),
    ],
)
def test_properties_that_do_not_fit_are_named(change, message, tmp_path):
    write_ply(tmp_path / "a.ply", change)
    with pytest.raises(ValueError, match=message):
        files.load(tmp_path / "a.ply")


def test_damaged_files_give_one_line_with_the_path(tmp_path):
    path = tmp_path / "a.ply"
    files.save(path, some_splats())
    good = path.read_bytes()
    header, body = good.split(b"end_header\n")
    endless = header + b"comment " + b"x" * 200_000 + b"\nend_header\n" + body
    damaged = {
        "truncated": good[:-10],
        "no vertices": header.replace(b"vertex 20", b"vertex 0") + b"end_header\n",
        "claims too many": good.replace(b"vertex 20", b"vertex 99999999999"),
        "negative": good.replace(b"vertex 20", b"vertex -20"),
        "endless header": endless,
        "no end of header": header,
        "twice": good.replace(b"float y\n", b"float x\n"),
        "list": good.replace(b"float x\n", b"list uchar float x\n"),
        "not a ply": b"solid teapot",
        "nothing": b"",
    }
    for case, data in damaged.items():
        path.write_bytes(data)
        with pytest.raises(ValueError) as caught:  # noqa: PT011 (the loop checks it)
            files.load(path)
        message = str(caught.value)
        assert message.startswith(f"{path}: "), case
        assert "\n" not in message, case
        assert len(message) < 300 + len(str(path)), case


def test_splat_keeps_its_bytes_and_its_quantization(tmp_path):
    rows = some_splats(degree=0)
    files.save(tmp_path / "a.splat", rows)
    assert (tmp_path / "a.splat").stat().st_size == 20 * 32
    # What covers most comes first.
    opacity, volume = opacities(rows)[0], np.exp(np.sum(rows.log_scale, axis=1))
    order = np.argsort(-opacity * volume)
    assert (order != np.arange(20)).any()
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[order], rows)
    back = files.load(tmp_path / "a.splat").splats
    np.testing.assert_array_equal(back.mean, rows.mean)
    np.testing.assert_allclose(back.log_scale, rows.log_scale, atol=2e-6)
    assert same_rotation(back.quaternion, rows.quaternion).max() < 1e-4
    np.testing.assert_allclose(*opacities(back, rows), atol=0.51 / 255)
    now, before = (0.5 + 0.2820948 * np.asarray(x.sh_dc) for x in (back, rows))
    np.testing.assert_allclose(now, np.clip(before, 0, 1), atol=0.51 / 255)
    files.save(tmp_path / "b.splat", back)
    again = files.load(tmp_path / "b.splat").splats
    same_bits(again._replace(quaternion=0), back._replace(quaternion=0))


@pytest.mark.parametrize(
    ("version", "degree"),
    [(2, 0), (3, 1), (4, 3), *full((2, 1), (2, 3), (3, 0), (3, 3), (4, 0), (4, 1))],
)
def test_spz_comes_back_within_its_steps(version, degree, tmp_path):
    if version == 4:
        pytest.importorskip("zstandard")
    rows = some_splats(count=200, degree=degree)
    files.save(tmp_path / "a.spz", rows, spz_version=version)
    back = files.load(tmp_path / "a.spz").splats
    np.testing.assert_allclose(back.mean, rows.mean, atol=0.5001 / 4096)
    np.testing.assert_allclose(back.log_scale, rows.log_scale, atol=0.5001 / 16)
    np.testing.assert_allclose(back.sh_dc, rows.sh_dc, atol=0.5001 / 255 / 0.15)
    np.testing.assert_allclose(*opacities(back, rows), atol=0.51 / 255)
    # Half a step of 8/128 for degree 1 and of 16/128 above, and the half of 1/128.
    error = np.abs(np.asarray(back.sh_rest) - np.asarray(rows.sh_rest))
    assert (error[:, :3] < 4.51 / 128).all()
    assert (error[:, 3:] < 8.51 / 128).all()
    # Version 2 derives w from three bytes: w near 0 is known to sqrt(2 * 3 / 255).
    assert same_rotation(back.quaternion, rows.quaternion).max() < (
        5e-3 if version == 2 else 1e-5
    )
    files.save(tmp_path / "b.spz", back, spz_version=version)
    again = files.load(tmp_path / "b.spz").splats
    same_bits(again._replace(quaternion=0), back._replace(quaternion=0))


def test_spz_turns_the_axes_of_means_rotations_and_harmonics():
    flip, rng = np.array([1.0, -1, -1]), np.random.default_rng(0)
    direction = rng.normal(size=(50, 3)).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    basis = jax.jit(lambda direction: harmonics.basis(direction, 3))
    here, there = (
        np.stack(basis(x)) for x in (direction, np.float32(flip) * direction)
    )
    sign = np.reshape(spz._SH_SIGN, (15, 1))
    np.testing.assert_allclose(there[1:], sign * here[1:], atol=1e-6)
    q = np.array([0.1, 0.7, -0.5, 0.5])
    turned = np.diag(flip) @ rotations(q).as_matrix() @ np.diag(flip)
    matrices = rotations(q * spz._TURN_SIGN).as_matrix()
    np.testing.assert_allclose(matrices, turned, atol=1e-12)


@pytest.mark.parametrize("kind", ["v3", "v4", *full("raw", "v2")])
def test_spz_files_of_another_tool_hold_the_same_four_gaussians(kind, data_dir):
    if kind == "v4":
        pytest.importorskip("zstandard")
    rows = files.load(data_dir / "splat_files" / f"minimal-{kind}.spz").splats
    splat = files.load(data_dir / "splat_files" / "minimal.splat").splats
    corners = {tuple(map(abs, row)) for row in np.asarray(rows.mean).tolist()}
    assert corners == {(1, 0, 1), (0, 0, 1), (1, 0, 0), (0, 0, 0)}
    np.testing.assert_allclose(np.exp(rows.log_scale), 0.1, rtol=0.05)
    np.testing.assert_allclose(np.exp(splat.log_scale), 0.1, rtol=1e-5)
    for opacity in opacities(rows, splat):
        np.testing.assert_allclose(opacity, 0.902, atol=2e-3)


def test_damaged_spz_files_are_refused(tmp_path):
    path = tmp_path / "a.spz"
    files.save(path, some_splats())
    good = path.read_bytes()
    inside = gzip.decompress(good)

    def with_header(**fields):
        names = ("version", "count", "degree", "bits", "flags", "spare")
        values = dict(zip(names, struct.unpack("<IIBBBB", inside[4:16]), strict=True))
        head = b"NGSP" + struct.pack("<IIBBBB", *(values | fields).values())
        return gzip.compress(head + inside[16:])

    damaged = {
        "truncated": (good[:-40], "truncated|damaged"),
        "short inside": (gzip.compress(inside[:-5]), "truncated: 20 Gaussians need"),
        "garbage": (b"PK\x03\x04 not at all", "not an SPZ file"),
        "bomb": (with_header(count=2**32 - 1), "more than .* bytes can hold"),
        "empty": (with_header(count=0), "no Gaussians"),
        "version": (with_header(version=1), "SPZ version 1"),
        "future": (b"NGSP" + struct.pack("<I", 9) + bytes(40), "SPZ version 9"),
        "degree": (with_header(degree=4), "degree 4"),
        "bits": (with_header(bits=200), "200 fraction bits"),
        "nothing": (b"", "not an SPZ file"),
    }
    for data, message in damaged.values():
        path.write_bytes(data)
        with pytest.raises(ValueError, match=message) as caught:
            files.load(path)
        assert str(caught.value).startswith(f"{path}: ")


def test_damaged_zstd_streams_are_refused(tmp_path):
    pytest.importorskip("zstandard")
    path = tmp_path / "a.spz"
    files.save(path, some_splats(), spz_version=4)
    good = path.read_bytes()
    for data in (
        good[:20],
        good[:-4],
        good[:8] + struct.pack("<I", 10**9) + good[12:],
        good[:15] + b"\x01" + good[16:],
        good[:130] + b"\xff\xff" + good[132:],
    ):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"a\.spz: "):
            files.load(path)


def test_version_4_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "zstandard", None)
    with pytest.raises(ValueError, match=r"nerfies-jax\[spz\]"):
        files.save(tmp_path / "a.spz", some_splats(), spz_version=4)
    assert list(tmp_path.iterdir()) == []


def test_other_wrong_names_and_places(tmp_path):
    rows = some_splats(2)
    with pytest.raises(ValueError, match=r"cannot write \.obj"):
        files.save(tmp_path / "a.obj", rows)
    far = edited(rows, mean=((1, 0), 3000.0))
    with pytest.raises(
        ValueError, match="3000 scene units from the origin, but SPZ ends"
    ):
        files.save(tmp_path / "a.spz", far)
    with pytest.raises(ValueError, match="cannot read a file without suffix"):
        files.load(tmp_path / "a")
    with pytest.raises(ValueError, match="no such file"):
        files.load(tmp_path / "a.ply")
    with pytest.raises(ValueError, match="cannot be written"):
        files.save(tmp_path / "nowhere" / "a.ply", rows)
    (tmp_path / "odd.splat").write_bytes(bytes(33))
    with pytest.raises(ValueError, match="33 bytes is not a multiple of 32"):
        files.load(tmp_path / "odd.splat")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    files.save(path, some_splats(3))
    before = path.read_bytes()

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ValueError, match="No space left on device"):
        files.save(path, some_splats(5))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.hard_cases
def test_a_signaling_nan_is_a_broken_row_and_no_warning(tmp_path):
    files.save(tmp_path / "a.splat", some_splats(3))
    data = bytearray((tmp_path / "a.splat").read_bytes())
    data[32 + 12 : 32 + 16] = struct.pack("<I", 0x7FA00000)
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(ValueError, match="row 1 has a log_scale"):
        files.load(tmp_path / "a.splat")
    assert files.load(tmp_path / "a.splat", drop_broken=True).dropped == 1


@pytest.mark.hard_cases
def test_saturated_zero_and_extreme_rows_survive_every_format(tmp_path):
    rows = edited(
        some_splats(4, degree=1),
        opacity_logit=(..., [100, -100, 0, 17]),
        log_scale=(..., np.reshape([-100, 100, 0, 5], (4, 1))),
        quaternion=(0, 0),
    )
    for suffix in files.SUFFIXES:
        files.save(tmp_path / f"a{suffix}", rows)
        back = files.load(tmp_path / f"a{suffix}").splats
        # A .splat has the largest first, which here is the last.
        expected = [1, 0.5, 0, 1] if suffix == ".splat" else [1, 0, 0.5, 1]
        np.testing.assert_allclose(*opacities(back), expected, atol=2.1e-3)
        assert all(np.isfinite(leaf).all() for leaf in back)


@pytest.mark.hard_cases
@pytest.mark.parametrize("suffix", [*files.SUFFIXES, ".npz"])
def test_a_row_of_nan_opacity_is_refused_and_not_taken_for_inactive(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    broken = edited(some_splats(), opacity_logit=(1, np.nan))
    save, what = files.save, (broken,)
    if suffix == ".npz":
        save, what = model_file.save, (Params({"splats": broken}, {}), {})
    with pytest.raises(ValueError, match="opacity_logit"):
        save(path, *what)
    assert not path.exists()


@pytest.mark.hard_cases
def test_the_largest_harmonics_are_held_and_do_not_overflow(tmp_path):
    """Above 2e36 scaling them in float32 overflowed, which warnings make an error."""
    size = float(np.finfo(np.float32).max) * np.array([1.0, -1.0, 0.0])
    rows = edited(some_splats(), sh_dc=(..., size), sh_rest=(..., size))
    files.save(tmp_path / "a.spz", rows, spz_version=3)
    loaded = files.load(tmp_path / "a.spz").splats
    ends = np.array([127.5, -127.5]) / 255 / 0.15
    np.testing.assert_allclose(loaded.sh_dc[0, 0, :2], ends, atol=0.5001 / 255 / 0.15)
    assert np.all(np.abs(loaded.sh_rest[..., :2]) >= 1 - 8 / 128)


def test_comments_of_gaussian_files_may_have_any_letters(tmp_path):
    rows = splats.from_points(np.eye(3, dtype=np.float32), np.full((3, 3), 0.5))
    path = tmp_path / "a.ply"
    files.save(path, rows)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"\nelement", "\ncomment für\nelement".encode()))
    np.testing.assert_array_equal(files.load(path).splats.mean, rows.mean)
