"""What other tools found takes the place of our own, or is refused in words."""

import dataclasses

import numpy as np
import OpenEXR
import PIL.Image
import pytest

from nerfies_jax.capture import capture as captures
from nerfies_jax.capture import images
from nerfies_jax.capture.given import GivenFiles
from nerfies_jax.preprocessing import given_depth, given_files, record, usable_paths
from nerfies_jax.preprocessing.rest_points import RestPoints
from nerfies_jax.preprocessing.tracks import Tracks, pixel_of
from tests.preprocessing import films
from tests.preprocessing.test_summary import card_points
from tests.preprocessing.test_tracks import MOVES, gathered


def with_files(capture=None, **files):
    capture = films.film(**MOVES, frames=24) if capture is None else capture
    return given_files.attached(capture, GivenFiles(**files))


def tapir(path, **changes):
    """Exact tracks of the card, [tracks, frames, 2]; the picture begins at 0."""
    capture, evidence = gathered()
    points = card_points(capture, evidence.row)
    arrays = {"tracks": points.pixel, "visibles": points.seen} | changes
    np.savez(path, **arrays)
    return path, points


@pytest.mark.parametrize("layout", ["tapir", "cotracker", "frames first"])
def test_tracks_are_read_in_each_layout(tmp_path, layout):
    path, points = tapir(tmp_path / "t.npz")
    if layout != "tapir":
        first = np.moveaxis(points.pixel, 0, 1)
        seen = points.seen.T.astype(np.float32)
        named = {"tracks": first, "visibles": seen}
        if layout == "cotracker":
            # Counted from the center of the first pixel.
            named = {"pred_tracks": first[None] - 0.5, "pred_visibility": seen[None]}
        np.savez(path, **named)
    capture = with_files(tracks=path)
    place = np.moveaxis(capture.given.track_pixel, 0, 1)[points.seen]
    np.testing.assert_allclose(place, points.pixel[points.seen], atol=1e-4)
    np.testing.assert_array_equal(capture.given.track_seen.T, points.seen)
    assert record.digest(capture) != record.digest(gathered()[0])


def test_paths_are_those_of_the_tracks_given_and_masks_are_the_masks(tmp_path):
    path, points = tapir(tmp_path / "t.npz")
    capture = films.film(**MOVES, frames=24)
    for row, name in enumerate(capture.ids):
        large = capture.moving[row].repeat(2, 0).repeat(2, 1)
        cut_out = np.where(large, 255, 0)[..., None] * [0, 0, 0, 1] + [255, 255, 255, 0]
        images.write_png(tmp_path / f"{name}.png", cut_out.astype(np.uint8))
    capture = with_files(capture, tracks=path, masks=tmp_path)
    share = capture.moving.mean()
    assert (
        f"masks of alpha, opaque is taken as white; {share:.1%} white: moving"
        in (capture.notes[-1])
    )
    evidence = record.gather(capture)
    np.testing.assert_array_equal(evidence.moving, capture.moving[evidence.row])
    assert evidence.told
    assert len(evidence.moved) == len(points.pixel)
    pixel = evidence.tracks.pixel[evidence.moved]
    np.testing.assert_allclose(pixel[points.seen], points.pixel[points.seen], atol=1e-4)
    off = np.linalg.norm(evidence.paths.position - points.position, axis=-1)
    known = evidence.paths.known
    assert np.median(off[known]) < 0.1 * films.NEAR  # drawn toward the wall
    # Our own tracks still say where the wall is.
    assert len(evidence.still.position) > 2000


def test_paths_whose_places_are_given_are_taken_as_they_are(tmp_path):
    path, points = tapir(tmp_path / "t.npz")
    capture = with_files(tracks=path)
    rows = gathered()[1].row
    place = np.zeros((len(capture.ids), *points.seen.T.shape[1:], 3), np.float32)
    place[rows] = np.moveaxis(points.position, 0, 1)
    given = capture.given._replace(track_place=place)
    evidence = record.gather(dataclasses.replace(capture, given=given))
    kept = evidence.paths.known
    found, pixel = evidence.paths.position, evidence.tracks.pixel[evidence.moved]
    assert kept.sum() > 0.9 * points.seen.sum()
    for row, frame in zip(*np.nonzero(kept), strict=True):
        which = np.abs(points.pixel[:, frame] - pixel[row, frame]).sum(1).argmin()
        assert np.array_equal(found[row, frame], place[rows[frame], which])
    assert not evidence.paths.depth_deviation.any()


def test_a_mover_that_was_marked_is_no_noise_however_small():
    _, found = gathered()
    small = found._replace(moving=np.zeros_like(found.moving))
    small.moving[:, :2, :5] = True
    assert small.moving.mean() < usable_paths.LEAST_MOVING
    assert "of the pixels show moving" in usable_paths.unusable(small)
    times = np.linspace(0, 1, len(small.row))
    assert usable_paths.stands_still(small, times)
    marked = small._replace(told=True)
    assert usable_paths.unusable(marked) == ""
    assert not usable_paths.stands_still(marked, times)


def test_tracks_of_larger_pictures_are_brought_to_those_that_are_read(tmp_path):
    _, points = tapir(tmp_path / "t.npz")
    size = 4 * np.array(films.SIZE)
    path, _ = tapir(tmp_path / "t.npz", tracks=4 * points.pixel, size=size)
    given = with_files(tracks=path).given
    place = np.moveaxis(given.track_pixel, 0, 1)[points.seen]
    np.testing.assert_allclose(place, points.pixel[points.seen], atol=1e-3)


@pytest.mark.parametrize("inverse", [False, True])
def test_depths_of_any_scale_are_brought_to_the_points_at_rest(inverse):
    rng = np.random.default_rng(0)
    true = np.float32(rng.uniform(1, 4, (3, 20, 30)))
    given = 5 / true + 0.4 if inverse else 7 * true - 2
    given[:, :2] = np.nan
    pixel = np.float32(rng.uniform(0, (30, 20), (80, 1, 2)).repeat(3, 1))
    tracks = Tracks(np.zeros(80, int), pixel, np.ones((80, 3), bool))
    row, column = pixel_of(pixel, true.shape[1:])
    depth = true[np.arange(3), row, column].astype(float)
    depth[:8] *= 3  # points that are wrong
    aligned, miss = given_depth.aligned(given, tracks, RestPoints(None, None, depth))
    # The penalty of the offset is what is left.
    np.testing.assert_allclose(aligned[:, 2:], true[:, 2:], rtol=0.03)
    assert np.isnan(aligned[:, :2]).all()
    assert miss < 0.01
    noise = np.float32(rng.uniform(1, 4, true.shape))
    assert given_depth.aligned(noise, tracks, RestPoints(None, None, depth))[1] > 0.1


@pytest.mark.full
def test_paths_lean_on_depths_given(tmp_path):
    film, folders = films.film(**MOVES, frames=24), {}
    for kind in ("exr", "png"):
        folders[kind] = tmp_path / kind
        folders[kind].mkdir()
        for row, name in enumerate(film.ids):
            depth = (7 + 0.1 * row) * film.depths[row]
            path = folders[kind] / f"{name}.{kind}"
            if kind == "exr":
                OpenEXR.File({}, {"Z": depth}).write(str(path))
            else:  # as depth cameras write it: millimeters, far below 16 bits
                stored = np.round(100 * depth).astype(np.uint16)
                PIL.Image.fromarray(stored).save(path)
    captures_of = {kind: with_files(film, depths=folders[kind]) for kind in folders}
    exr, png = (captures_of[kind].given.depth for kind in folders)
    np.testing.assert_allclose(png / png.max(), exr / exr.max(), atol=1e-3)
    evidence = record.gather(captures_of["png"])
    own = gathered()[1]
    off, without = (
        np.abs(one.paths.depth[one.paths.known] - films.NEAR).mean()
        for one in (evidence, own)
    )
    assert off < 0.5 * without


def test_flow_given_is_taken_and_checked_both_ways(tmp_path):
    capture, own = gathered()
    forward, backward = own.flow.forward[:-1], own.flow.backward[1:].copy()
    backward[3] += 5
    for side, array in (("forward", forward), ("backward", backward)):
        (tmp_path / side).mkdir()
        for number, one in enumerate(array):
            head = np.float32(202021.25).tobytes()
            head += np.array(one.shape[1::-1], "<i4").tobytes()
            (tmp_path / side / f"{number}.flo").write_bytes(head + one.tobytes())
    evidence = record.gather(with_files(capture, flow=tmp_path))
    np.testing.assert_array_equal(evidence.flow.forward, own.flow.forward)
    assert not evidence.flow.forward_seen[3].any()
    np.testing.assert_array_equal(
        evidence.flow.forward_seen[4], own.flow.forward_seen[4]
    )


def refused(refusal, **files):
    with pytest.raises(captures.CaptureError, match=refusal):
        with_files(**files)


def test_what_does_not_fit_is_refused_with_the_file_and_the_way_out(tmp_path):
    path, points = tapir(tmp_path / "t.npz", visibles=np.zeros((16, 24), bool))
    refused(
        r"t\.npz: 0 of 0 visible positions .* add their width and height", tracks=path
    )
    tapir(path, tracks=points.pixel * 9)
    refused(r"at least half must be", tracks=path)
    tapir(path, tracks=points.pixel[:, :7], visibles=points.seen[:, :7])
    refused(r"tracks of 7 frames|tracks of 16 frames", tracks=path)
    np.savez(path, points=points.pixel)
    refused(r"holds points; expected tracks and visibles or pred_tracks", tracks=path)
    path.write_bytes(b"cut short")
    refused(r"not a readable npz", tracks=path)
    refused(r"no such folder of masks", masks=tmp_path / "nowhere")
    refused(r"contains no masks \(\.png", masks=tmp_path)
    images.write_png(tmp_path / "0.png", np.zeros((72, 96), bool))
    refused(r"masks of 1 frames, but the capture has 24 frames", masks=tmp_path)
    for row in range(24):
        images.write_png(tmp_path / f"{row}.png", np.ones((72, 96), bool))
    refused(r"no black pixel in any mask \(the one value 255\)", masks=tmp_path)
    depths = tmp_path / "d.npz"
    np.savez(depths, depths=np.ones((24, 72, 72)))
    refused(r"a depth of 72x72 pixels for images of 96x72", depths=depths)
    np.savez(depths, depths=np.zeros((24, 72, 96)))
    refused(r"no positive depth", depths=depths)
    np.savez(depths, forward=np.zeros((23, 72, 96, 2)))
    refused(r"no 'backward' flow; both directions are needed", flow=depths)
    for side, sizes in (("forward", [(3, 2), (3, 4)]), ("backward", [(3, 2)] * 2)):
        (tmp_path / "flow" / side).mkdir(parents=True)
        for number, size in enumerate(sizes):
            head = (
                np.float32(given_files.FLO_MAGIC).tobytes() + np.int32(size).tobytes()
            )
            pixels = np.zeros(2 * size[0] * size[1], np.float32).tobytes()
            (tmp_path / "flow" / side / f"{number}.flo").write_bytes(head + pixels)
    refused(r"1\.flo: 3x4 pixels, but 0\.flo has 3x2", flow=tmp_path / "flow")
    bent = films.film(**MOVES, frames=24)
    bent.cameras.radial[:, 0] = 0.1
    refused(r"undistort the capture first", capture=bent, tracks=path)
    rng = np.random.default_rng(0)
    np.savez(depths, depths=rng.uniform(0.1, 9, (24, 72, 96)))
    with pytest.raises(ValueError, match="static points"):
        record.gather(with_files(depths=depths))


def test_a_capture_cut_to_some_frames_keeps_what_was_given_for_them(tmp_path):
    path, _ = tapir(tmp_path / "t.npz")
    capture = with_files(tracks=path)
    part = captures.select(capture, np.arange(3, 9))
    np.testing.assert_array_equal(
        part.given.track_pixel, capture.given.track_pixel[3:9]
    )
    assert dataclasses.replace(part, given=None).given is None
