"""Two passes of cameras, what is kept of them, and what a second call does."""

import dataclasses
import json
import shutil
import types

import numpy as np
import PIL.Image
import pytest

from nerfies_jax import capture as room
from nerfies_jax.capture import images, video
from nerfies_jax.capture import masks as mask_files
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.sfm_features import COARSE_PX
from nerfies_jax.capture.structure_from_motion import FewPlaced, Poses
from nerfies_jax.preprocessing import masks_without_cameras
from nerfies_jax.runs import movers, preparation, reconstruction
from nerfies_jax.runs.config import (
    CaptureSource,
    MoreMetrics,
    Preparation,
    RunConfig,
)
from tests import scenes
from tests.capture import test_colmap as models


@pytest.fixture
def mapper(monkeypatch):
    """COLMAP, which here writes a model by hand; its `calls`, each with its masks.

    Where it `fails`, the second call places three photographs fewer.
    """
    calls, options = [], []

    def run_sfm(photographs, out, masks, spec, *, groups, features):
        options.append((groups, features))
        names = sorted(path.name for path in photographs.iterdir())
        models.make(out, count=len(names))
        text = (out / "sparse/0/images.txt").read_text()
        for row, name in enumerate(names):
            text = text.replace(f"f_{row:03d}.png", name)
            (out / f"images/f_{row:03d}.png").unlink()
            (out / "images" / name).write_bytes((photographs / name).read_bytes())
        (out / "sparse/0/images.txt").write_text(text)
        black = None
        if masks is not None:
            shutil.copytree(masks, out / "masks")
            black = [~mask_files.read_mask(masks / f"{name}.png") for name in names]
        calls.append((spec, black))
        placed = len(names) - (3 if len(calls) == 2 and run_sfm.fails else 0)
        return Poses(out, len(names), placed, 40, 0.5, 6.0)

    run_sfm.fails, run_sfm.calls, run_sfm.options = False, calls, options
    monkeypatch.setattr(preparation, "run_sfm", run_sfm)
    return run_sfm


@pytest.fixture
def moving(monkeypatch):
    """What is taken to move: a corner in the third image."""
    moving = np.zeros((9, 16, 24), bool)
    moving[2, 10:, 15:] = True
    monkeypatch.setattr(movers, "masks_of", lambda capture: moving)
    return moving


@pytest.fixture
def clip(tmp_path):
    frames = [models.image(row).repeat(2, 0).repeat(2, 1) for row in range(9)]
    video.write_video(tmp_path / "clip.mp4", frames, 30)
    return tmp_path / "clip.mp4"


@pytest.fixture
def photographs(tmp_path):
    folder = tmp_path / "photographs"
    folder.mkdir()
    for row in range(9):
        images.write_png(folder / f"p{row}.png", models.image(row))
    return folder


def test_the_second_pass_goes_without_what_the_first_saw_move(
    photographs, tmp_path, mapper, moving
):
    how = Preparation(camera_model="RADIAL", matcher="exhaustive", threads=1)
    capture = preparation.prepare(photographs, tmp_path / "out", how)
    (spec, black), (second, masked) = mapper.calls
    assert black is None
    assert (spec.least_scale, second.least_scale) == (COARSE_PX, 0)
    # Features are computed once.
    assert len({features for _, features in mapper.options}) == 1
    assert (spec.camera_model, spec.matcher, spec.threads) == (
        "RADIAL",
        "exhaustive",
        1,
    )
    for row, mask in enumerate(masked):
        assert mask[moving[row]].all()
        assert mask.any() == moving[row].any()
        assert mask.sum() <= 1.5 * moving[row].sum()  # the rim
    stored = room.load(tmp_path / "out")
    np.testing.assert_array_equal(stored.images, capture.images)
    assert stored.moving is None  # found, and no truth
    shown = mask_files.read_mask(tmp_path / "out/masks_found/p2.png")
    np.testing.assert_array_equal(shown, moving[2])
    assert (tmp_path / "out/colmap/sparse/0/images.txt").is_file()
    assert not list(tmp_path.glob(".*"))


def test_masks_are_of_every_frame_and_of_its_size(monkeypatch):
    capture = scenes.tiny_capture()
    order = np.array([3, 0, 6, 5, 1, 4, 2])
    small = np.random.default_rng(0).random((7, 7, 10)) < 0.2  # a quarter, and 2 rest
    moving = types.SimpleNamespace(unusable="", moving=small, row=order, factor=4)

    def gather(mapper, rough_cameras, masks_only):
        assert rough_cameras  # of the first pass
        assert masks_only
        assert mapper.train.tolist() == list(range(7))  # held-out ones too
        return moving

    monkeypatch.setattr(movers.record, "gather", gather)
    masks = movers.masks_of(capture)
    assert masks.shape == capture.images.shape[:3]
    for row, mask in zip(order, small, strict=True):
        np.testing.assert_array_equal(masks[row, 2:28:4, 1::4], mask)
        # What is no whole block is like its edge.
        np.testing.assert_array_equal(masks[row, 29, 1::4], mask[-1])
    moving.unusable = "the camera jumps"
    assert movers.masks_of(capture) is None
    moving.unusable, moving.moving = "", np.zeros_like(small)
    assert movers.masks_of(capture) is None


def test_a_second_pass_that_loses_images_is_not_taken(
    photographs, tmp_path, mapper, moving
):
    del moving
    mapper.fails, log = True, []
    preparation.prepare(photographs, tmp_path / "out", tell=log.append)
    assert any("registered only 6 of the 9 images" in line for line in log)
    assert not (tmp_path / "out/masks_found").exists()


def test_where_too_few_are_placed_what_moves_is_masked_before(
    photographs, tmp_path, mapper, monkeypatch
):
    moves = {f"p{row}.png": np.zeros((16, 24), bool) for row in range(9)}
    moves["p2.png"][10:, 15:] = True
    monkeypatch.setattr(masks_without_cameras, "moving_in", lambda folder: moves)

    def too_few_unmasked(photographs, out, masks, spec, **rest):
        if masks is None and spec.at_least > 0:
            raise FewPlaced(f"{photographs}: only 1 of 9 images could be registered", 1)
        return mapper(photographs, out, masks, spec, **rest)

    monkeypatch.setattr(preparation, "run_sfm", too_few_unmasked)
    log = []
    preparation.prepare(photographs, tmp_path / "out", tell=log.append)
    ((_, black),) = mapper.calls
    assert [mask.any() for mask in black] == [row == 2 for row in range(9)]
    shown = mask_files.read_mask(tmp_path / "out/masks_found/p2.png")
    np.testing.assert_array_equal(shown, moves["p2.png"])
    assert log[0].startswith("only 1 of 9")
    moves["p2.png"][:] = False  # nothing to leave out: the first reason is told
    for how in (Preparation(), Preparation(passes=1)):
        with pytest.raises(CaptureError, match="only 1 of 9"):
            preparation.prepare(photographs, tmp_path / "again", how)
    # A piece of the images is used on request.
    for row, passes in enumerate((1, 2)):
        how = Preparation(passes=passes, piece=True)
        preparation.prepare(photographs, tmp_path / f"piece{row}", how)
    assert [black is None for _, black in mapper.calls] == [False, True, True]


def test_photographs_of_several_cameras_have_a_camera_each(
    tmp_path, mapper, monkeypatch
):
    monkeypatch.setattr(movers, "masks_of", lambda capture: None)
    folder = tmp_path / "photographs"
    folder.mkdir()
    lenses = (("One", 36), ("One", 72), ("Two", 36), (None, None))
    for row in range(9):
        exif = PIL.Image.Exif()
        name, focal = lenses[row % 4]
        if name:
            exif[0x0110] = name
            exif.get_ifd(0x8769)[0xA405] = focal
        image = PIL.Image.fromarray(models.image(row))
        image.save(folder / f"p{row}.png", exif=exif)
    preparation.prepare(folder, tmp_path / "auto")
    groups, _ = mapper.options[0]
    assert [(group.names[0], group.focal) for group in groups] == [
        ("p0.png", 1.0),
        ("p1.png", 2.0),
        ("p2.png", 1.0),
        ("p3.png", 1.0),  # the median of the others
    ]
    assert sorted(name for group in groups for name in group.names) == [
        f"p{row}.png" for row in range(9)
    ]
    assert not mapper.calls[0][0].is_sequential(500)
    preparation.prepare(folder, tmp_path / "one", Preparation(cameras="one"))
    assert len(mapper.options[-1][0]) == 1


def test_given_masks_take_one_pass_and_are_kept(photographs, tmp_path, mapper):
    (tmp_path / "masks").mkdir()
    for row in range(9):
        mask = np.ones((16, 24), bool)
        mask[:, : row + 1] = False
        images.write_png(tmp_path / f"masks/p{row}.png", mask)
    how = Preparation(masks=tmp_path / "masks")
    preparation.prepare(photographs, tmp_path / "out", how)
    ((_, black),) = mapper.calls
    assert [mask[0].sum() for mask in black] == list(range(1, 10))
    np.testing.assert_array_equal(room.load(tmp_path / "out").moving, black)


def test_other_masks_make_another_capture_and_what_is_no_image_does_not(
    photographs, tmp_path, mapper
):
    (tmp_path / "masks").mkdir()
    mask = np.ones((16, 24), bool)
    for row in range(9):
        images.write_png(tmp_path / f"masks/p{row}.png", mask)
    how = Preparation(masks=tmp_path / "masks")
    preparation.prepared(photographs, tmp_path / "out", how)
    for folder in (photographs, tmp_path / "masks"):
        for name in (".DS_Store", "Thumbs.db", "._p0.png"):
            (folder / name).write_bytes(b"of a file manager")
    log = []
    preparation.prepared(photographs, tmp_path / "out", how, log.append)
    assert "has already been converted" in log[0]
    assert len(mapper.calls) == 1
    mask[3:5] = False
    images.write_png(tmp_path / "masks/p4.png", mask)
    with pytest.raises(ValueError, match=r"\(masks differ\)"):
        preparation.prepared(photographs, tmp_path / "out", how)
    gone = Preparation(masks=tmp_path / "gone")
    with pytest.raises(CaptureError, match="gone: no such folder of masks"):
        preparation.prepared(photographs, tmp_path / "out", gone)
    # One made before masks were looked at has had none.
    preparation.prepared(photographs, tmp_path / "without")
    record = json.loads((tmp_path / "without/prepared.json").read_text())
    del record["masks"]
    (tmp_path / "without/prepared.json").write_text(json.dumps(record))
    preparation.prepared(photographs, tmp_path / "without")


def test_a_run_of_a_video_prepares_it_once_beside_the_run(
    clip, tmp_path, mapper, monkeypatch
):
    monkeypatch.setattr(movers, "masks_of", lambda capture: None)
    config = RunConfig(source=CaptureSource(clip, heldout="4"))
    how = Preparation(frames=9, max_side=24)
    for _ in range(2):
        moving = reconstruction._with_cameras(config, tmp_path / "run", how)
        assert moving.source.capture == tmp_path / "run-capture"
        assert moving.source.heldout == "4"
    # The second pass, though nothing moves: from finer features.
    assert [black for _, black in mapper.calls] == [None, None]
    assert not (tmp_path / "run-capture/masks_found").exists()
    capture = room.load(tmp_path / "run-capture")
    assert capture.frames_per_second == pytest.approx(30, abs=0.2)
    assert reconstruction._with_cameras(moving, None, Preparation()) is moving
    # As many threads as there are cores change nothing; another video does.
    threads = dataclasses.replace(how, threads=3)
    reconstruction._with_cameras(config, tmp_path / "run", threads)
    content = clip.read_bytes()
    clip.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(ValueError, match=r"run-capture: .*content differ"):
        reconstruction._with_cameras(config, tmp_path / "run", how)
    clip.write_bytes(content)
    other = dataclasses.replace(how, passes=1)
    with pytest.raises(ValueError, match=r"run-capture: .*how differ.*out="):
        reconstruction._with_cameras(config, tmp_path / "run", other)


def test_what_cannot_be_prepared_is_refused_and_leaves_nothing(photographs, tmp_path):
    with pytest.raises(CaptureError, match=r"nothing\.mp4: no such video"):
        preparation.prepare(tmp_path / "nothing.mp4", tmp_path / "out")
    with pytest.raises(CaptureError, match="neither a video"):
        preparation.prepare(photographs / "p0.png", tmp_path / "out")
    with pytest.raises(ValueError, match="select frames of a video"):
        preparation.prepare(photographs, tmp_path / "out", Preparation(frames=5))
    with pytest.raises(CaptureError, match="maskz: no such folder of masks"):
        preparation.prepare(
            photographs, tmp_path / "out", Preparation(masks=tmp_path / "maskz")
        )
    assert [path.name for path in tmp_path.iterdir()] == ["photographs"]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"threads": 0}, "threads=0"),
        ({"max_side": 8}, "max_side=8"),
        ({"frames": 9, "fps": 2.0}, "mutually exclusive"),
    ],
)
def test_wrong_settings_are_refused_before_a_video_is_read(wrong, words):
    with pytest.raises(ValueError, match=words):
        Preparation(**wrong)


def test_wrong_words_are_refused_before_cameras_are_looked_for(clip, tmp_path, mapper):
    source = CaptureSource(clip)
    wrong = [RunConfig("nerf-smal", source), RunConfig("nerf", source, steps=0)]
    # None: one that tracks choose. No such preset has these.
    wrong += [
        RunConfig(None, source, steps=-3),
        RunConfig(None, source, None, ("a=1",)),
    ]
    for config in wrong:
        with pytest.raises(reconstruction.Refused):
            reconstruction.reconstruct(config, tmp_path / "run")
    more = MoreMetrics(lpips_weights=(tmp_path / "a.npz",))
    with pytest.raises(reconstruction.Refused, match=r"a\.npz: No such file"):
        reconstruction.reconstruct(RunConfig(None, source), tmp_path / "run", more=more)
    assert mapper.calls == []
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]
