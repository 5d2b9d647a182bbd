"""Text and file names as other operating systems and programs write them."""

import json
import shutil
import unicodedata

import numpy as np
import plyfile
import pytest

from nerfies_jax import capture as room
from nerfies_jax.capture import points, text_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.json_files import named_file, read_json
from tests.capture import test_blender_format, test_colmap, test_nerfies_format
from tests.capture.broken import edited

UNICODE = ("utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32")


@pytest.mark.parametrize("encoding", UNICODE)
def test_json_in_any_unicode_encoding_is_read(encoding, tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes('{"name": "Glühwürmchen"}'.encode(encoding))
    assert read_json(path) == {"name": "Glühwürmchen"}


def test_json_cut_within_a_character_of_utf_16_names_the_encoding(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes('{"a": 1}'.encode("utf-16")[:-1])
    with pytest.raises(CaptureError, match=r"a\.json: .*utf-16.* save the file as UTF"):
        read_json(path)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_comments_of_ply_files_may_have_any_letters(text, encoding, tmp_path):
    rows = np.array([(1, 2, 3), (200, 5, 6)], [(axis, "<f4") for axis in "xyz"])
    vertex = plyfile.PlyElement.describe(rows, "vertex")
    path = tmp_path / "a.ply"
    plyfile.PlyData([vertex], text, "<", comments=["by X"]).write(str(path))
    path.write_bytes(path.read_bytes().replace(b"by X", "für Ä".encode(encoding)))
    np.testing.assert_array_equal(
        points.read_ply(path).position, [[1, 2, 3], [200, 5, 6]]
    )


@pytest.mark.parametrize("encoding", UNICODE)
def test_text_ply_files_may_be_of_any_unicode_encoding(encoding, tmp_path):
    path = tmp_path / "a.ply"
    header = "ply\r\nformat ascii 1.0\r\ncomment für\r\nelement vertex 1\r\n"
    header += "".join(f"property float {axis}\r\n" for axis in "xyz")
    path.write_bytes(f"{header}end_header\r\n1 2 3\r\n".encode(encoding))
    np.testing.assert_array_equal(points.read_ply(path).position, [[1, 2, 3]])


@pytest.mark.parametrize(
    ("named", "on_disk"),
    [
        ("images\\a.png", "images/a.png"),
        ("images/a.png", "Images/A.PNG"),
        (
            unicodedata.normalize("NFC", "é/ü.png"),
            unicodedata.normalize("NFD", "é/ü.png"),
        ),
        (
            unicodedata.normalize("NFD", "é/ü.png"),
            unicodedata.normalize("NFC", "É/ü.png"),
        ),
        ("a\\b.png", "a\\b.png"),
    ],
)
def test_files_are_found_under_other_spellings(named, on_disk, tmp_path):
    path = tmp_path / on_disk
    path.parent.mkdir(exist_ok=True)
    path.touch()
    assert text_files.find(tmp_path, named) == path


def test_a_spelling_that_fits_two_files_fits_none(tmp_path):
    (tmp_path / "A.png").touch()
    (tmp_path / "a.PNG").touch()
    assert text_files.find(tmp_path, "a.png") is None
    assert text_files.find(tmp_path, "A.png") == tmp_path / "A.png"


@pytest.mark.parametrize("name", ["..\\secret", "LINK"])
def test_other_spellings_lead_nowhere_outside(name, tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "secret").touch()
    (root / "link").symlink_to(tmp_path / "secret")
    with pytest.raises(CaptureError, match="leads outside"):
        named_file(root, name, root / "transforms.json")


@pytest.mark.parametrize("folder", ["/home/me/scene/", "C:\\me\\", "../scene/"])
def test_paths_of_another_machine_are_those_of_this_folder(folder, tmp_path):
    expected = room.load(test_blender_format.make(tmp_path, {"": 6}))
    with edited(tmp_path / "transforms.json") as content:
        for entry in content["frames"]:
            name = entry["file_path"].removeprefix("./")
            name = name.replace("/", "\\" if "C" in folder else "/")
            entry["file_path"] = folder + name
    read = room.load(tmp_path)
    assert read.ids == expected.ids
    np.testing.assert_array_equal(read.images, expected.images)
    assert any("6 file names are paths in another" in note for note in read.notes)


def test_transforms_written_on_windows_are_read(tmp_path):
    """A byte order mark, backslashes, and images with other endings and case."""
    expected = room.load(test_blender_format.make(tmp_path, {"": 6}))
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    for row, entry in enumerate(content["frames"]):
        entry["file_path"] = f"images\\r_{row}.{'jpg' if row % 2 else 'png'}"
    names = [entry["file_path"] for entry in content["frames"]]
    lists = {"train_filenames": names[1:], "test_filenames": ["images/r_0.png"]}
    path.write_text(json.dumps(content | lists), encoding="utf-8-sig")
    (tmp_path / "images").rename(tmp_path / "Images")
    capture = room.load(tmp_path)
    assert sorted(capture.ids) == sorted(expected.ids)
    by_id = dict(zip(expected.ids, expected.images, strict=True))
    for name, image in zip(capture.ids, capture.images, strict=True):
        np.testing.assert_array_equal(image, by_id[name])
    assert [capture.ids[row] for row in capture.heldout] == ["images_r_0"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_models_of_colmap_keep_spaces_in_names(encoding, tmp_path):
    test_colmap.make(tmp_path)
    for row in range(9):
        old = tmp_path / f"images/f_{row:03d}.png"
        old.rename(tmp_path / f"images/für mich ({row}).png")
    for file in (tmp_path / "sparse/0").glob("*.txt"):
        text = file.read_text()
        for row in range(9):
            text = text.replace(f"f_{row:03d}.png", f"für mich ({row}).png")
        file.write_text("# für alle\n" + text, encoding=encoding)
    capture = room.load(tmp_path)
    assert capture.ids == tuple(f"für mich ({row})" for row in range(9))


def test_a_broken_model_among_others_is_passed_over_with_a_note(tmp_path):
    test_colmap.make(tmp_path)
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    (tmp_path / "sparse/1/points3D.txt").unlink()
    capture = room.load(tmp_path)
    assert any(note.startswith("skipped: sparse/1") for note in capture.notes)
    (tmp_path / "sparse/0/points3D.txt").unlink()
    with pytest.raises(CaptureError, match="sparse/0: not a readable COLMAP model"):
        room.load(tmp_path)


def test_frames_without_a_camera_file_can_be_left_out(tmp_path):
    test_nerfies_format.make(tmp_path)
    (tmp_path / "camera/003.json").unlink()
    with pytest.raises(CaptureError, match=r"dataset.json: 1 of 6 .*camera/003.json"):
        room.load(tmp_path)
    capture = room.load(tmp_path, missing="skip")
    assert capture.ids == ("000", "001", "002", "004", "005")
    assert [capture.ids[row] for row in capture.heldout] == ["001", "005"]
    assert any("camera/003.json" in note for note in capture.notes)
