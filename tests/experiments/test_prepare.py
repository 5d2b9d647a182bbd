"""Captures from archives and videos."""

import numpy as np
import pytest

from experiments import prepare
from nerfies_jax import capture as room
from nerfies_jax.capture import npz_archive, video


def pose(angle):
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3] = [[-s, 0, c, 4 * c], [c, 0, s, 4 * s], [0, 1, 0, 0]]
    return matrix


def archive(path, **changes):
    """Ten rows from a moving camera, six from a tripod, four more of another set."""
    rng = np.random.default_rng(0)
    angles = [*np.arange(10.0), *[3.3] * 6, *np.arange(20.0, 24.0)]
    images = rng.random((20, 8, 10, 3)).astype(np.float32)
    images[:, [0, 0, -1, -1], [0, -1, 0, -1]] = 0
    arrays = {
        "images": images,
        "poses": np.stack([pose(angle) for angle in angles]).astype(np.float32),
        "times": np.linspace(0, 1, 20).astype(np.float32),
        "focal": np.array(12.0),
    }
    arrays |= changes
    np.savez(path, **{name: a for name, a in arrays.items() if a is not None})
    return arrays


def test_a_tripod_sweep_is_held_out(tmp_path, capsys):
    arrays = archive(tmp_path / "a.npz")
    prepare.main(["npz", str(tmp_path / "a.npz"), str(tmp_path / "out")])
    assert "4 rows after them left out" in capsys.readouterr().out
    capture = room.load(tmp_path / "out")
    assert (capture.train.size, capture.heldout.size) == (10, 6)
    np.testing.assert_allclose(capture.times, arrays["times"][:16], atol=1e-7)
    exact = arrays["images"][:16] * 255
    assert np.abs(capture.images - exact).max() <= 0.5001
    np.testing.assert_allclose(capture.cameras.focal_px, 12, rtol=1e-6)
    np.testing.assert_allclose(
        capture.cameras.position, arrays["poses"][:16, :3, 3], atol=1e-6
    )
    assert capture.background == (0.0, 0.0, 0.0)
    assert not list(tmp_path.glob(".*"))


def test_rows_can_be_named(tmp_path):
    archive(tmp_path / "a.npz", times=None)
    command = ["npz", str(tmp_path / "a.npz"), str(tmp_path / "out")]
    prepare.main([*command, "--heldout", "16:20", "--train", "0:3"])
    capture = room.load(tmp_path / "out")
    assert (capture.train.size, capture.heldout.size) == (3, 4)


def test_a_source_says_its_kind(tmp_path, capsys, monkeypatch):
    archive(tmp_path / "a.npz")
    prepare.main([str(tmp_path / "a.npz"), str(tmp_path / "out")])
    assert room.load(tmp_path / "out").train.size == 10
    assert prepare.with_kind([str(tmp_path), "out"])[0] == "images"
    assert prepare.with_kind(["clip.MP4", "out"])[0] == "video"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "video").mkdir()
    unchanged = (["video", "clip.mp4", "out"], ["--help"], [], ["notes.txt", "out"])
    for words in unchanged:
        assert prepare.with_kind(words) == words


BAD = {
    "no focal": (dict(focal=None), [], "'focal'"),
    "focal zero": (dict(focal=np.array(0.0)), [], "focal = 0"),
    "poses short": (dict(poses=np.zeros((19, 4, 4))), [], "20 images"),
    "gray": (dict(images=np.zeros((20, 8, 10), np.float32)), [], "(20, 8, 10)"),
    "too bright": (dict(images=np.full((20, 8, 10, 3), 7.0)), [], "to 7"),
    "NaN": (dict(poses=np.full((20, 4, 4), np.nan)), [], "NaN"),
    "objects": (dict(times=np.array([{}] * 20)), [], "not a readable .npz"),
    "time outside": (dict(times=np.linspace(0, 2, 20)), [], "times from 0 to 2"),
    "no time": (dict(times=np.full(20, np.nan)), [], "a.npz: holds NaN"),
    "no length": (dict(focal=np.zeros(0)), [], "focal is empty"),
    "one number": (dict(images=np.float32(1)), [], "images ()"),
    "no images": (dict(images=np.zeros((0, 8, 10, 3))), [], "(0, 8, 10, 3)"),
    "rows outside": ({}, ["--heldout", "15:25"], "15:25"),
    "rows as words": ({}, ["--heldout", "some"], "some"),
    "train alone": ({}, ["--train", "0:5"], "--heldout"),
    "rows twice": ({}, ["--heldout", "5:9", "--train", "0:7"], "share row 5"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_archives_end_with_code_2_and_leave_nothing(tmp_path, capsys, case):
    changes, options, refusal = BAD[case]
    archive(tmp_path / "a.npz", **changes)
    with pytest.raises(SystemExit) as caught:
        prepare.main(["npz", str(tmp_path / "a.npz"), str(tmp_path / "out"), *options])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert refusal in error
    assert error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_an_archive_cut_short_and_a_place_in_use(tmp_path):
    archive(tmp_path / "a.npz")
    data = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "b.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"b\.npz: not a readable"):
        npz_archive.convert(tmp_path / "b.npz", tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").touch()
    with pytest.raises(ValueError, match="already there"):
        npz_archive.convert(tmp_path / "a.npz", tmp_path / "out")


@pytest.mark.slow
def test_a_video_without_texture_is_refused_and_leaves_nothing(tmp_path, capsys):
    frames = [np.full((64, 64, 3), 100 + k, np.uint8) for k in range(6)]
    video.write_video(tmp_path / "a.mp4", frames)
    with pytest.raises(SystemExit) as caught:
        prepare.main(["video", str(tmp_path / "a.mp4"), str(tmp_path / "out")])
    assert caught.value.code == 2
    assert f"{tmp_path / 'a.mp4'}: only 0 of 6 images" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.slow
def test_a_real_video_becomes_a_capture(data_dir, tmp_path):
    from nerfies_jax.capture import images

    files = sorted((data_dir / "nrnerf_bookshelf/rgb/1x").glob("*.png"))
    frames = [images.read_image(file)[0] for file in files]
    video.write_video(tmp_path / "a.mp4", frames, 15, quality=6)
    out = tmp_path / "out"
    prepare.main(["video", str(tmp_path / "a.mp4"), str(out), "--frames", "18"])
    capture = room.load(out)
    assert len(capture.ids) >= 17
    known = room.load(data_dir / "nrnerf_bookshelf")
    rows = [round(int(name.removeprefix("ms")) * 15 / 1000) for name in capture.ids]
    one = capture.cameras.position.astype(float)
    other = known.cameras.position[rows].astype(float)
    one, other = one - one.mean(0), other - other.mean(0)
    u, values, v = np.linalg.svd(other.T @ one)
    turned = values.sum() / (one**2).sum() * one @ (u @ v).T
    error = np.linalg.norm(turned - other, axis=1)
    # 2 % of the path's extent: two reconstructions of the same hand-held video
    assert np.median(error) < 0.02 * np.linalg.norm(np.ptp(other, axis=0))


def test_the_tiny_lego_archive(data_dir, tmp_path):
    source = data_dir / "dnerf_lego_tiny/tiny_dnerf_data.npz"
    prepare.main(["npz", str(source), str(tmp_path / "out")])
    capture = room.load(tmp_path / "out")
    assert (capture.train.size, capture.heldout.size) == (50, 11)  # rows 0-49 and 50-60
    known = np.load(data_dir / "dnerf_lego_tiny/cameras.npz")
    poses = known["c2w_opencv"][:61]
    np.testing.assert_allclose(capture.cameras.position, poses[:, :, 3], atol=1e-6)
    rotation = capture.cameras.camera_from_world.swapaxes(1, 2)
    np.testing.assert_allclose(rotation, poses[:, :, :3], atol=3e-7)
    assert capture.cameras.focal_px[0] == pytest.approx(known["K"][0, 0, 0], rel=1e-6)
    np.testing.assert_allclose(capture.times, known["time"][:61], atol=1e-6)
