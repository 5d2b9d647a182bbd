"""One file for a trained scene: the same bits back, and nothing else accepted."""

import json
import zipfile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params
from gaussians_jax.io import model_file
from gaussians_jax.scene import scene
from nerfies_jax import evaluation
from tests import scenes
from tests.gaussians.motions import moving_scene
from tests.gaussians.shared import jitted, put, with_rows

SIZE = (20, 15)


@pytest.fixture(scope="module")
def trained():
    """A deformable scene with inactive rows in between, and what describes it."""
    params = jax.tree.map(np.asarray, moving_scene(0.02))
    rows = params.rows["splats"]
    inactive = np.arange(len(rows.mean)) % 7 == 0
    logit = np.where(inactive, splats.INACTIVE_LOGIT, rows.opacity_logit)
    codes = np.random.default_rng(0).normal(size=(len(rows.mean), 5))
    rows = {"splats": rows._replace(opacity_logit=logit), "codes": codes}
    metadata = scene.metadata_of(scenes.tiny_capture())
    about = {"spec": scenes.TINY_DEFORMABLE, "metadata": metadata, "step": 20}
    return put(params._replace(rows=rows), "float32"), about | {"name": "tiny"}


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
    expected = jax.jit(splats.take_rows)(params, active)
    assert 0 < len(active) < len(params.rows["codes"])
    assert jax.tree.structure(loaded) == jax.tree.structure(expected)
    for leaf, exact in zip(*map(jax.tree.leaves, (loaded, expected)), strict=True):
        assert leaf.dtype == exact.dtype == jnp.float32
        np.testing.assert_array_equal(leaf, exact)
    assert described == about
    assert hash(described["spec"]) == hash(about["spec"])


@pytest.mark.full
def test_a_frame_is_drawn_from_the_file_alone(trained, saved):
    view = evaluation.view_of(scenes.tiny_capture(), 3)
    images = []
    for params, about in (trained, model_file.load(saved)):
        model = scene.build(about["spec"], about["metadata"])
        draw = jitted(model.render, static_argnums=2)
        images.append(draw(params, view, SIZE, np.int32(about["step"])).color)
    assert np.ptp(images[0]) > 0.1
    np.testing.assert_allclose(images[1], images[0], atol=1e-6)


def test_float64_is_stored_in_float32(trained, tmp_path, float64):
    params, about = trained
    wide = put(
        jax.tree.map(
            lambda leaf: leaf.astype(float) + 1e-12, jax.tree.map(np.asarray, params)
        )
    )
    model_file.save(tmp_path / "model.npz", wide, about)
    loaded, _ = model_file.load(tmp_path / "model.npz")
    active = np.asarray(splats.active_mask(params.rows["splats"]))
    mean = np.asarray(wide.rows["splats"].mean)[active].astype(np.float32)
    assert loaded.rows["splats"].mean.dtype == np.float32
    np.testing.assert_array_equal(loaded.rows["splats"].mean, mean)


def test_a_failed_save_leaves_the_file_that_was_there(trained, saved):
    params, about = trained
    before = saved.read_bytes()
    nan = jax.tree.map(lambda leaf: np.full_like(leaf, np.nan), params.nets)
    broken = params._replace(nets=put(nan))
    with pytest.raises(ValueError, match=r"model\.npz: params\.nets\..* not finite"):
        model_file.save(saved, broken, about)
    with pytest.raises(ValueError, match=r"model\.npz: spec\.f is a function"):
        model_file.save(saved, params, {"f": lambda: 0})
    logit = np.full_like(params.rows["splats"].opacity_logit, splats.INACTIVE_LOGIT)
    with pytest.raises(
        ValueError, match=r"model\.npz: none of the .* Gaussians is active"
    ):
        model_file.save(saved, with_rows(params, opacity_logit=put(logit)), about)
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


def test_a_truncated_or_foreign_file_is_refused(saved):
    whole = saved.read_bytes()
    contents = [
        whole[: int(share * len(whole))] for share in (0, 0.01, 0.3, 0.9, 0.999)
    ]
    contents += [b"ply\nformat ascii 1.0\n", b"\x93NUMPY\x01\x00v\x00{}", b"\0" * 4096]
    for content in contents:
        saved.write_bytes(content)
        refused(saved, "not a model file, or damaged")
    np.savez(saved, mean=np.zeros((3, 3)))
    refused(saved, r"it has no about\.json")


def test_a_flipped_byte_in_the_numbers_is_noticed(saved):
    whole = bytearray(saved.read_bytes())
    with zipfile.ZipFile(saved) as archive:
        entry = archive.getinfo("params.rows.splats.mean.npy")
    place = entry.header_offset + 200 + entry.compress_size // 2
    whole[place] ^= 0x55
    saved.write_bytes(whole)
    refused(saved, "damaged|decompressing|CRC")


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
            "has version 1, but this version of the library reads version 2",
        ),
        (
            lambda a: a.update(format="something"),
            r"does not describe a gaussians_jax model",
        ),
        (lambda a: a.pop("params"), "params"),
        (lambda a: a.pop("description"), "description"),
        (lambda a: a.update(params={"array": "nobody"}), "nobody"),
        (lambda a: a.update(params={"dict": {}}), r"holds no Gaussians"),
        (lambda a: a.update(params=3), "not iterable"),
        (lambda a: a["params"].update(record="os.system"), "'os.system', which is no"),
        (
            lambda a: a["params"].update(record="gaussians_jax.io.files.os"),
            "which is no",
        ),
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
        (np.zeros((3, 5), np.float32), r"array of shape \(3, 5\)"),
        (np.array([{}], object), "Python objects"),
        (np.zeros((), np.float32), r"array of shape \(\)"),
        (None, "not finite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(trained, saved, array, words):
    if array is None:
        logit = np.asarray(trained[0].rows["splats"].opacity_logit)
        active = np.count_nonzero(logit != splats.INACTIVE_LOGIT)
        array = np.full((active, 5), np.inf, np.float32)
    edited(saved, lambda about: None, {"params.rows.codes": array})
    refused(saved, words)


class Beside(NamedTuple):
    """A record of no package."""

    table: jax.Array


def test_a_record_of_another_program_does_not_come_back(trained, tmp_path):
    params, about = trained
    odd = Params(params.rows, {"beside": Beside(put(np.zeros(3)))})
    model_file.save(tmp_path / "model.npz", odd, about)
    refused(tmp_path / "model.npz", "of another package, whose code")


@pytest.mark.full
def test_whole_numbers_and_lists_keep_their_kind(trained, tmp_path):
    params, about = trained
    inner = {"inner": put(np.ones((2, 3), bool))}
    nets = {"table": (put(np.arange(4), "int32"), None, inner)}
    about = {"list": [1, 2.5, [None, "x"]], "plain": {"a": True}}
    model_file.save(tmp_path / "model.npz", params._replace(nets=nets), about)
    loaded, described = model_file.load(tmp_path / "model.npz")
    assert described == {"list": (1, 2.5, (None, "x")), "plain": {"a": True}}
    jax.tree.map(np.testing.assert_array_equal, loaded.nets, nets)
    assert loaded.nets["table"][0].dtype == np.int32
