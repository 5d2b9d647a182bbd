"""One file for a trained scene: the same bits back, and nothing else accepted."""

import json
import zipfile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax import model_file, scene, splats
from gaussians_jax.splats import Params
from nerfies_jax import evaluation
from tests import scenes

SIZE = (20, 15)


@pytest.fixture(scope="module")
def trained():
    """A deformable scene with inactive rows in between, and what describes it."""
    capture = scenes.tiny_capture()
    metadata = scene.metadata_of(capture)
    model = scene.build(scenes.TINY_DEFORMABLE, metadata)
    params = model.init(capture, jax.random.key(0)).params
    params = params._replace(nets=jax.tree.map(lambda leaf: leaf + 0.02, params.nets))
    rows = params.rows["splats"]
    inactive = jnp.arange(len(rows.mean)) % 7 == 0
    codes = jnp.asarray(np.random.default_rng(0).normal(size=(len(rows.mean), 5)))
    params = params._replace(
        rows={
            "splats": splats.deactivate(rows, inactive),
            "codes": codes.astype(jnp.float32),
        }
    )
    about = {
        "spec": scenes.TINY_DEFORMABLE,
        "metadata": metadata,
        "step": 20,
        "name": "tiny",
    }
    return params, about


@pytest.fixture
def saved(trained, tmp_path):
    path = tmp_path / "model.npz"
    size = model_file.save(path, *trained)
    assert size == path.stat().st_size
    return path


def test_active_rows_networks_and_settings_come_back_bit_for_bit(trained, saved):
    params, about = trained
    loaded, described = model_file.load(saved)
    active = np.flatnonzero(splats.active_mask(params.rows["splats"]))
    expected = splats.take_rows(params, jnp.asarray(active))
    assert 0 < len(active) < len(params.rows["codes"])
    assert jax.tree.structure(loaded) == jax.tree.structure(expected)
    for found, exact in zip(*map(jax.tree.leaves, (loaded, expected)), strict=True):
        assert found.dtype == exact.dtype == jnp.float32
        np.testing.assert_array_equal(found, exact)
    assert described == about
    assert hash(described["spec"]) == hash(about["spec"])


@pytest.mark.full
def test_the_file_is_about_as_large_as_its_numbers(trained, saved):
    loaded, _ = model_file.load(saved)
    numbers = sum(leaf.nbytes for leaf in jax.tree.leaves(loaded))
    assert saved.stat().st_size < 1.05 * numbers + 40_000


@pytest.mark.full
def test_a_frame_is_drawn_from_the_file_alone(trained, saved):
    params, about = trained
    view = evaluation.view_of(scenes.tiny_capture(), 3)
    pictures = []
    for params, about in (trained, model_file.load(saved)):
        model = scene.build(about["spec"], about["metadata"])
        step = jnp.asarray(about["step"], jnp.int32)
        draw = jax.jit(model.render, static_argnums=2)
        pictures.append(draw(params, view, SIZE, step).colour)
    assert np.ptp(pictures[0]) > 0.1
    np.testing.assert_allclose(pictures[1], pictures[0], atol=1e-6)


def test_float64_is_stored_in_float32(trained, tmp_path, float64):
    params, about = trained
    wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float64) + 1e-12, params)
    model_file.save(tmp_path / "model.npz", wide, about)
    loaded, _ = model_file.load(tmp_path / "model.npz")
    active = np.asarray(splats.active_mask(params.rows["splats"]))
    mean = np.asarray(wide.rows["splats"].mean)[active].astype(np.float32)
    assert loaded.rows["splats"].mean.dtype == np.float32
    np.testing.assert_array_equal(loaded.rows["splats"].mean, mean)


def test_a_failed_save_leaves_the_file_that_was_there(trained, saved):
    params, about = trained
    before = saved.read_bytes()
    broken = params._replace(
        nets=jax.tree.map(lambda leaf: leaf * jnp.nan, params.nets)
    )
    with pytest.raises(ValueError, match=r"model\.npz: params\.nets\..* not finite"):
        model_file.save(saved, broken, about)
    with pytest.raises(ValueError, match=r"model\.npz: spec\.f holds a function"):
        model_file.save(saved, params, {"f": lambda: 0})
    rows = params.rows["splats"]
    none = params.rows | {
        "splats": splats.deactivate(rows, rows.mean[:, 0] == rows.mean[:, 0])
    }
    with pytest.raises(ValueError, match=r"model\.npz: none of the .* rows is active"):
        model_file.save(saved, params._replace(rows=none), about)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["model.npz"]


def test_a_folder_that_is_not_there_is_named(trained, tmp_path):
    with pytest.raises(ValueError, match=r"nowhere/model\.npz"):
        model_file.save(tmp_path / "nowhere" / "model.npz", *trained)
    with pytest.raises(ValueError, match=r"nowhere\.npz: no such file"):
        model_file.load(tmp_path / "nowhere.npz")


def refused(path, words):
    with pytest.raises(ValueError, match=words) as error:
        model_file.load(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_a_truncated_file_is_refused_wherever_it_ends(saved):
    whole = saved.read_bytes()
    for share in (0, 0.01, 0.3, 0.9, 0.999):
        saved.write_bytes(whole[: int(share * len(whole))])
        refused(saved, "not the file of a model, or damaged")


def test_a_flipped_byte_in_the_numbers_is_noticed(saved):
    whole = bytearray(saved.read_bytes())
    with zipfile.ZipFile(saved) as archive:
        entry = archive.getinfo("params.rows.splats.mean.npy")
    place = entry.header_offset + 200 + entry.compress_size // 2
    whole[place] ^= 0x55
    saved.write_bytes(whole)
    refused(saved, "damaged|decompressing|CRC")


@pytest.mark.parametrize(
    "content", [b"ply\nformat ascii 1.0\n", b"\x93NUMPY\x01\x00v\x00{}", b"\0" * 4096]
)
def test_a_foreign_file_is_refused(content, tmp_path):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    refused(path, "not the file of a model, or damaged")


def test_another_archive_is_refused(tmp_path):
    path = tmp_path / "model.npz"
    np.savez(path, mean=np.zeros((3, 3)))
    refused(path, r"it has no about\.json")


def edited(path, change, arrays=()):
    """Write the same archive again, its text and arrays changed."""
    with np.load(path) as file:
        content = {name: file[name] for name in file.files}
    about = json.loads(content[model_file.ABOUT].tobytes())
    change(about)
    content[model_file.ABOUT] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    np.savez(path, **content | dict(arrays))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda a: a.update(version=1),
            "of version 1, and this program reads version 2",
        ),
        (lambda a: a.update(format="something"), r"not that of a gaussians_jax model"),
        (lambda a: a.pop("params"), "params"),
        (lambda a: a.pop("description"), "description"),
        (lambda a: a.update(params={"array": "nobody"}), "nobody"),
        (lambda a: a.update(params={"dict": {}}), r"no Gaussians in it"),
        (lambda a: a.update(params=3), "not iterable"),
        (lambda a: a["params"].update(record="os.system"), "'os.system', which is no"),
        (lambda a: a["params"].update(record="gaussians_jax.files.os"), "which is no"),
        (lambda a: a["params"].update(record="gaussians_jax.none.X"), "which is no"),
        (
            lambda a: a["description"]["spec"].update(type="subprocess.Popen"),
            "'subprocess.Popen', which is no",
        ),
        (
            lambda a: a["description"]["spec"].update(hair=3),
            "stored SplatScene with .*hair.* is none of this version",
        ),
        (
            lambda a: a["description"]["spec"].update(sh_degree=9),
            "sh_degree=9 must be 0, 1, 2 or 3",
        ),
    ],
)
def test_a_text_that_fits_no_model_is_refused(saved, change, words):
    edited(saved, change)
    refused(saved, words)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((3, 5), np.float32), r"shape \(3, 5\) among the rows of"),
        (np.array([{}], object), "allow_pickle"),
        (np.zeros((), np.float32), r"shape \(\) among the rows"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(saved, array, words):
    edited(saved, lambda about: None, {"params.rows.codes": array})
    refused(saved, words)


def test_numbers_that_are_not_finite_are_refused(trained, saved):
    active = int(splats.active_mask(trained[0].rows["splats"]).sum())
    codes = np.full((active, 5), np.inf, np.float32)
    edited(saved, lambda about: None, {"params.rows.codes": codes})
    refused(saved, "not finite")


class Beside(NamedTuple):
    """A record of no package."""

    table: jax.Array


def test_a_record_of_another_program_does_not_come_back(trained, tmp_path):
    params, about = trained
    odd = Params(params.rows, {"beside": Beside(jnp.zeros(3))})
    model_file.save(tmp_path / "model.npz", odd, about)
    refused(tmp_path / "model.npz", "which is no record or setting")


@pytest.mark.full
def test_whole_numbers_and_lists_keep_their_kind(trained, tmp_path):
    params, about = trained
    nets = {"table": (jnp.arange(4), None, {"inner": jnp.ones((2, 3), bool)})}
    about = {"list": [1, 2.5, [None, "x"]], "plain": {"a": True}}
    model_file.save(tmp_path / "model.npz", params._replace(nets=nets), about)
    loaded, described = model_file.load(tmp_path / "model.npz")
    assert described == {"list": (1, 2.5, (None, "x")), "plain": {"a": True}}
    jax.tree.map(np.testing.assert_array_equal, loaded.nets, nets)
    assert loaded.nets["table"][0].dtype == np.int32
