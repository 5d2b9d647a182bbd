"""Files from strangers: links out of a capture, bombs, pipes and headers that lie."""

import io
import os
import zipfile

import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture import (
    blender_format,
    colmap,
    formats,
    json_files,
    llff_format,
    nerfies_format,
    npz_files,
    points,
    safe_files,
)
from nerfies_jax.capture.capture import CaptureError
from tests.capture import test_blender_format, test_colmap, test_nerfies_format
from tests.capture.broken import edited


def nerfies(root):
    test_nerfies_format.make(root)
    (root / "valid/1x").mkdir(parents=True)
    (root / "depth/1x").mkdir(parents=True)
    for row in range(6):
        mask = np.full((8, 12), 255, np.uint8)
        mask[: row + 1] = 0
        PIL.Image.fromarray(mask).save(root / f"valid/1x/00{row}.png")
        np.save(root / f"depth/1x/00{row}.npy", np.ones((8, 12), np.float32))
    np.save(root / "points.npy", np.ones((9, 3)))
    np.save(root / "points_color.npy", np.ones((9, 3), np.uint8))


def blender(root):
    test_blender_format.make(root)


def colmap_text(root):
    test_colmap.make(root)
    (root / "masks").mkdir()
    for row in range(9):
        mask = np.full((16, 24), 255, np.uint8)
        mask[: row + 1] = 0
        PIL.Image.fromarray(mask).save(root / f"masks/f_{row:03d}.png.png")


def llff(root):
    (root / "images").mkdir(parents=True)
    for row in range(9):
        image = test_colmap.image(row)
        PIL.Image.fromarray(image).save(root / f"images/{row}.png")
    table = np.zeros((9, 17))
    table[:, :15] = np.c_[np.eye(3), np.zeros(3), [16, 24, 30]].ravel()
    table[:, 3], table[:, 15:] = np.arange(9), (1, 5)
    np.save(root / "poses_bounds.npy", table)


LINKS = [
    *((nerfies, nerfies_format, name) for name in ("scene.json", "metadata.json")),
    *((nerfies, nerfies_format, name) for name in ("rgb", "rgb/1x", "rgb/1x/001.png")),
    *((nerfies, nerfies_format, name) for name in ("points.npy", "points_color.npy")),
    (nerfies, nerfies_format, "camera/001.json"),
    (nerfies, nerfies_format, "valid/1x/001.png"),
    (nerfies, nerfies_format, "depth/1x/001.npy"),
    (blender, blender_format, "transforms_test.json"),
    (blender, blender_format, "train/r_1.png"),  # whose name in the file has no ending
    (blender, blender_format, "train"),
    (colmap_text, colmap, "masks/f_001.png.png"),
    (colmap_text, colmap, "sparse/0/points3D.txt"),
    (colmap_text, colmap, "images"),
    (llff, llff_format, "poses_bounds.npy"),
    (llff, llff_format, "images/3.png"),
]


@pytest.mark.parametrize(("make", "module", "name"), LINKS)
def test_a_link_out_of_a_capture_is_refused_when_it_is_opened(
    tmp_path, make, module, name
):
    root = tmp_path / "scene"
    make(root)
    module.read(root)
    link = root / name
    link.rename(tmp_path / "secret")
    link.symlink_to(tmp_path / "secret")
    with pytest.raises(CaptureError, match="outside") as caught:
        module.read(root)
    assert str(root) in str(caught.value)


def test_links_inside_a_capture_and_to_it_are_followed(tmp_path):
    root = tmp_path / "scene"
    nerfies(root)
    (root / "rgb/1x/001.png").unlink()
    (root / "rgb/1x/001.png").symlink_to(root / "rgb/1x/002.png")
    (tmp_path / "alias").symlink_to(root)
    capture = formats.load(tmp_path / "alias")
    assert (capture.images[1] == capture.images[2]).all()


def test_a_pipe_in_place_of_a_file_is_refused_and_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "scene.json")
    with pytest.raises(CaptureError, match=r"scene\.json: not a regular file"):
        json_files.read_json(tmp_path / "scene.json")


def test_links_in_a_circle_are_refused_by_name(tmp_path):
    nerfies(tmp_path)
    (tmp_path / "scene.json").unlink()
    (tmp_path / "scene.json").symlink_to(tmp_path / "scene.json")
    with pytest.raises(CaptureError, match=r"scene\.json: "):
        nerfies_format.read(tmp_path)


@pytest.mark.parametrize("text", ["[" * 10**6, '{"a":' * 10**5, "1" * 5000, '"\\ud800'])
def test_json_that_no_decoder_likes_is_refused_by_name(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(CaptureError, match=r"a\.json: "):
        json_files.read_json(tmp_path / "a.json")


def header(text):
    raw = text.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(raw).to_bytes(2, "little") + raw


def described(kind, shape):
    return f"{{'descr':'{kind}','fortran_order':False,'shape':{shape}}}"


LIES = {
    "a formula": described("<f4", "(10**18,)"),
    "a petabyte": described("<f4", "(1000000000000000,)"),
    "too many digits": described("<f4", f"({'9' * 30},)"),
    "nothing by a lot": described("<U0", "(1000000000000,)"),
    "objects": described("|O", "(1,)"),
    "no Python": described("<f4", "(((((("),
    "negative": described("<f4", "(-1,-4)"),
}


@pytest.mark.parametrize("lie", LIES)
def test_the_header_of_an_array_is_believed_as_far_as_its_bytes_go(tmp_path, lie):
    content = header(LIES[lie]) + bytes(16)
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(CaptureError, match=r"a\.npy: not a readable array"):
        npz_files.load_array(tmp_path / "a.npy", 10**6)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(ValueError, match=r"header|array|holds"):
        npz_files.read_arrays(tmp_path / "a.npz")


def bomb(path, sizes, kind=zipfile.ZIP_DEFLATED):
    """An archive of arrays of zeros."""
    with zipfile.ZipFile(path, "w", kind) as archive:
        for number, size in enumerate(sizes):
            with archive.open(f"a{number}.npy", "w") as member:
                member.write(header(described("|u1", f"({size},)")))
                for _ in range(size >> 20):
                    member.write(bytes(2**20))


def test_archives_unpack_within_a_budget(tmp_path):
    bomb(tmp_path / "fine.npz", [2**20, 2**21])
    arrays = npz_files.read_arrays(tmp_path / "fine.npz")
    assert {name: len(array) for name, array in arrays.items()} == {
        "a0": 2**20,
        "a1": 2**21,
    }
    with pytest.raises(ValueError, match="at most 1000000"):
        npz_files.read_arrays(tmp_path / "fine.npz", 10**6)
    bomb(tmp_path / "odd.npz", [2**20], zipfile.ZIP_BZIP2)
    with pytest.raises(ValueError, match="a compression that NumPy"):
        npz_files.read_arrays(tmp_path / "odd.npz")


def test_an_archive_of_nothing_but_zeros_is_refused_before_it_is_unpacked(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(npz_files, "FREE_BYTES", 2**20)
    bomb(tmp_path / "a.npz", [2**21])
    with pytest.raises(ValueError, match="more than 100 times"):
        npz_files.read_arrays(tmp_path / "a.npz")


PLY = "ply\nformat {} 1.0\nelement vertex {}\n{}\nend_header\n"
POSITIONS = "\n".join(f"property float {axis}" for axis in "xyz")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (PLY.format("ascii", 10**12, POSITIONS), "header claims"),
        (PLY.format("binary_little_endian", 10**12, POSITIONS), "header claims"),
        (PLY.format("ascii", "-5", POSITIONS), "line"),
        (PLY.format("ascii", 1, f"{POSITIONS}\ncomment {'a' * 10**5}"), "end_header"),
        (
            PLY.format("ascii", 1, POSITIONS.replace("float x", "list int int x"))
            + "2 1 2 3 4\n",
            "not numbers: x",
        ),
        (
            PLY.format("binary_little_endian", 1, "property list uint double x")
            + "\0\0\0\x7f",
            "not a readable",
        ),
    ],
)
def test_a_ply_file_claims_no_more_than_it_holds(tmp_path, text, reason):
    (tmp_path / "a.ply").write_bytes(text.encode("latin1"))
    with pytest.raises(CaptureError, match=rf"a\.ply: .*{reason}"):
        points.read_ply(tmp_path / "a.ply")


def test_a_file_that_grows_over_its_budget_is_refused(tmp_path):
    (tmp_path / "a").write_bytes(bytes(11))
    assert safe_files.read_bytes(tmp_path / "a", 11) == bytes(11)
    with pytest.raises(CaptureError, match="at most 10"):
        safe_files.read_bytes(tmp_path / "a", 10)


def test_names_longer_than_the_system_allows_are_refused(tmp_path):
    blender(tmp_path)
    with edited(tmp_path / "transforms_train.json") as table:
        table["frames"][0]["file_path"] = "a" * 5000
    with pytest.raises(CaptureError, match="missing"):
        blender_format.read(tmp_path)


def test_arrays_come_back_as_numpy_saved_them(tmp_path):
    arrays = {
        "column": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "text": np.array(["a", "longer"]),
        "empty": np.zeros((0, 3), np.float32),
        "one": np.array(7, ">i2"),
        "flags": np.array([True, False]),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    (tmp_path / "a.npz").write_bytes(buffer.getvalue())
    back = npz_files.read_arrays(tmp_path / "a.npz")
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
