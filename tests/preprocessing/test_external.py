"""What other tools found takes the place of our own, or is refused in words."""

import dataclasses

import jax
import numpy as np
import pytest

from nerfies_jax.capture import capture as captures
from nerfies_jax.capture import images, pinholes
from nerfies_jax.capture.external import ExternalFiles, ExternalResults
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import rays
from nerfies_jax.preprocessing import (
    external_files,
    record,
    usable_paths,
)
from tests.preprocessing import two_planes
from tests.preprocessing.test_summary import card_points
from tests.preprocessing.test_tracks import MOVES, gathered


def with_files(capture=None, **files):
    capture = two_planes.make(**MOVES, frames=24) if capture is None else capture
    return external_files.attached(capture, ExternalFiles(**files))


def tapir(path, **changes):
    """Exact tracks of the card, [tracks, frames, 2]; the image begins at 0."""
    capture, evidence = gathered()
    points = card_points(capture, evidence.row)
    arrays = {"tracks": points.pixel, "visibles": points.visible} | changes
    np.savez(path, **arrays)
    return path, points


LAYOUTS = ("tapir", "cotracker", "frames first", "locotrack", "folder", "pairs")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_tracks_are_read_in_each_layout(tmp_path, layout):
    path, points = tapir(tmp_path / "t.npz")
    first = np.moveaxis(points.pixel, 0, 1)
    seen = points.visible.T.astype(np.float32)
    # Counted from the center of the first pixel, with a batch.
    named = {"pred_tracks": first[None] - 0.5, "pred_visibility": seen[None, ..., None]}
    logit = np.where(points.visible, -5.0, 5.0)
    if layout == "cotracker":
        np.savez(path, **named)
    elif layout == "frames first":
        np.savez(path, tracks=first, visibility=seen)
    elif layout == "locotrack":
        # Visible, but uncertain, is not visible either.
        parts = {"occlusion": -5 + 0 * logit[None], "expected_dist": logit[None]}
        np.savez(path, tracks=points.pixel[None], **parts)
    elif layout == "folder":
        path = tmp_path
        path.joinpath("t.npz").unlink()
        for name, array in named.items():
            np.save(path / f"clip_{name}.npy", array)
    elif (
        layout == "pairs"
    ):  # of query and target frames, as Shape of Motion stores them
        path = tmp_path / "pairs"
        path.mkdir()
        half = len(points.pixel) // 2
        for query, part in (("003", np.s_[:half]), ("010", np.s_[half:])):
            for frame in range(24):
                flag = logit[part, frame, None]
                table = [points.pixel[part, frame], flag, -5 + 0 * flag]
                np.save(path / f"{query}_{frame:03d}.npy", np.concatenate(table, 1))
    capture = with_files(tracks=path)
    place = np.moveaxis(capture.external.track_pixel, 0, 1)[points.visible]
    np.testing.assert_allclose(place, points.pixel[points.visible], atol=1e-4)
    np.testing.assert_array_equal(capture.external.track_seen.T, points.visible)
    assert record.digest(capture) != record.digest(gathered()[0])


def test_paths_are_those_of_the_tracks_given_and_masks_are_the_masks(tmp_path):
    path, points = tapir(tmp_path / "t.npz")
    capture = two_planes.make(**MOVES, frames=24)
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
    assert evidence.is_external
    assert len(evidence.paths.known) == len(points.pixel)
    pixel = evidence.path_tracks.pixel
    np.testing.assert_allclose(
        pixel[points.visible], points.pixel[points.visible], atol=1e-4
    )
    off = np.linalg.norm(evidence.paths.position - points.position, axis=-1)
    known = evidence.paths.known
    assert np.median(off[known]) < 0.1 * two_planes.NEAR  # drawn toward the wall
    # Our own tracks still say where the wall is.
    assert len(evidence.static_cloud.position) > 2000


def test_a_mover_that_was_marked_is_no_noise_however_small():
    _, evidence = gathered()
    small = evidence._replace(moving=np.zeros_like(evidence.moving))
    small.moving[:, :2, :5] = True
    assert small.moving.mean() < usable_paths.LEAST_MOVING
    assert "of the pixels show moving" in usable_paths.unusable(small)
    times = np.linspace(0, 1, len(small.row))
    assert usable_paths.is_static(small, times)
    marked = small._replace(is_external=True)
    assert "of the pixels show moving" not in usable_paths.unusable(marked)
    assert not usable_paths.is_static(marked, times)


def test_tracks_of_larger_images_are_brought_to_those_that_are_read(tmp_path):
    _, points = tapir(tmp_path / "t.npz")
    size = 4 * np.array(two_planes.SIZE)
    path, _ = tapir(tmp_path / "t.npz", tracks=4 * points.pixel, size=size)
    external = with_files(tracks=path).external
    place = np.moveaxis(external.track_pixel, 0, 1)[points.visible]
    np.testing.assert_allclose(place, points.pixel[points.visible], atol=1e-3)


@jax.jit
def directions(camera, pixel):
    return jax.vmap(lambda one: cameras.unproject(camera, one)[0])(pixel)


@jax.jit
def pixels(camera, point):
    return jax.vmap(lambda one: cameras.project(camera, one)[0])(point)


@pytest.mark.full
def test_results_for_distorted_images_are_mapped_to_undistorted_ones():
    """The geometry is that of a wall, by projection alone."""
    capture = two_planes.make(frames=3, blank=True)
    lens = capture.cameras._replace(radial=np.tile(np.float32([-0.2, 0.05, 0]), (3, 1)))
    bent = dataclasses.replace(capture, cameras=lens)
    wide = pinholes.canvas(bent)
    flat_cameras = cameras.crop(pinholes.pinhole(lens), -wide.left, -wide.top)

    def on_wall(all_cameras, frame, size):
        """Points [height, width, 3] that the pixels show, and their flow."""
        camera = cameras.take(all_cameras, frame)
        centers = rays.pixel_centers(size).reshape(-1, 2)
        ray = np.asarray(directions(camera, centers), float).reshape(*size[::-1], 3)
        return camera.position + ray * (two_planes.FAR / ray[..., 2:])

    def flow(all_cameras, frame, other, size):
        camera = cameras.take(all_cameras, other)
        point = np.float32(on_wall(all_cameras, frame, size)).reshape(-1, 3)
        there = np.asarray(pixels(camera, point))
        centers = np.asarray(rays.pixel_centers(size))
        return there.reshape(centers.shape) - centers

    def fields(all_cameras, size):
        """Depth, mask, and flow both ways of the three frames."""
        points = np.stack([on_wall(all_cameras, frame, size) for frame in range(3)])
        forward, backward = np.zeros((2, 3, *size[::-1], 2), np.float32)
        for frame in (0, 1):
            forward[frame] = flow(all_cameras, frame, frame + 1, size)
            backward[frame + 1] = flow(all_cameras, frame + 1, frame, size)
        # A depth that varies over the wall shows where it was sampled.
        return {
            "depth": np.float32(2 + points[..., 0]),
            "moving": points[..., 1] > 0.1,
            "forward": forward,
            "backward": backward,
        }

    point = np.float32(
        [[-0.3, 0.2, two_planes.FAR], [0.4, -0.3, two_planes.FAR], [9, 9, 2]]
    )

    def tracks(all_cameras):
        every = (cameras.take(all_cameras, frame) for frame in range(3))
        return np.stack([np.asarray(pixels(camera, point)) for camera in every])

    seen = np.tile([True, True, False], (3, 1))
    external = fields(lens, capture.size) | {
        "track_pixel": tracks(lens),
        "track_seen": seen,
    }
    straight = pinholes.as_pinholes(
        dataclasses.replace(bent, external=ExternalResults(capture.size, **external))
    ).external
    assert straight.size == wide.size
    np.testing.assert_array_equal(straight.track_seen, seen)
    expected = tracks(flat_cameras)[:, :2]
    np.testing.assert_allclose(straight.track_pixel[:, :2], expected, atol=0.01)
    expected = fields(flat_cameras, wide.size)
    known = np.isfinite(straight.depth)
    assert 0.7 < known.mean() < 1
    # Half a pixel of the sampling is 0.011 units.
    assert np.abs(straight.depth - expected["depth"])[known].max() < 0.02
    wrong = (straight.moving != expected["moving"])[known].mean()
    assert wrong < 0.02
    for side, frames in (("forward", np.s_[:2]), ("backward", np.s_[1:])):
        error = np.linalg.norm(getattr(straight, side) - expected[side], axis=-1)[
            frames
        ]
        # Within the image of the other frame too.
        assert np.quantile(error[known[frames]], 0.9) < 0.1
        assert (error[~known[frames]] > 1000).all()


@pytest.mark.full
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
    assert not evidence.flow.forward_valid[3].any()
    np.testing.assert_array_equal(
        evidence.flow.forward_valid[4], own.flow.forward_valid[4]
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
    tapir(path, tracks=points.pixel[:, :7], visibles=points.visible[:, :7])
    refused(r"tracks of 7 frames|tracks of 16 frames", tracks=path)
    np.savez(path, points=points.pixel)
    refused(r"contains points; expected tracks or pred_tracks, and", tracks=path)
    tapir(path, tracks=0 * points.pixel + [10, 90])
    refused(r"0 of .* seem to be exchanged: store x \(right\)", tracks=path)
    tapir(path, tracks=points.pixel * np.nan)
    refused(r"0 of 0 visible positions", tracks=path)
    tapir(path, size=np.array([0, 72]))
    refused(r"size is \[0, 72\]; expected the width and the height", tracks=path)
    tapir(path, visibles=points.visible[:, :9])
    refused(r"visibles of \(\d+, 9\); expected \[tracks, frames, 2\]", tracks=path)
    refused(r"not from \.pt files; save them with", tracks=tmp_path / "a.pt")
    pairs = tmp_path / "pairs"
    pairs.mkdir()
    for name in ("000_000", "000_001", "001_001"):
        np.save(pairs / f"{name}.npy", np.zeros((3, 4)))
    refused(r"no 001_000\.npy \(1 of 4 pairs", tracks=pairs)
    np.save(pairs / "001_000.npy", np.zeros((3, 2)))
    refused(r"001_000\.npy: an array of shape \(3, 2\); expected", tracks=pairs)
    np.save(pairs / "001_000.npy", np.zeros((2, 4)))
    refused(r"001_001\.npy: 3 points, but 001_000\.npy has 2", tracks=pairs)
    path.write_bytes(b"cut short")
    refused(r"not a readable .npz", tracks=path)
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
    np.savez(depths, depths=np.ones((24, 96, 72)))
    refused(r"its rows and columns seem to be exchanged", depths=depths)
    np.savez(depths, depths=np.full((24, 72, 96), np.nan))
    refused(r"no positive depth", depths=depths)
    np.savez(depths, depths=np.zeros((24, 72, 96)))
    refused(r"no positive depth", depths=depths)
    np.savez(depths, forward=np.zeros((23, 72, 96, 2)))
    refused(r"no 'backward' flow; both directions are needed", flow=depths)
    for side, sizes in (("forward", [(3, 2), (3, 4)]), ("backward", [(3, 2)] * 2)):
        (tmp_path / "flow" / side).mkdir(parents=True)
        for number, size in enumerate(sizes):
            head = (
                np.float32(external_files.FLO_MAGIC).tobytes()
                + np.int32(size).tobytes()
            )
            pixels = np.zeros(2 * size[0] * size[1], np.float32).tobytes()
            (tmp_path / "flow" / side / f"{number}.flo").write_bytes(head + pixels)
    refused(r"1\.flo: 3x4 pixels, but 0\.flo has 3x2", flow=tmp_path / "flow")
    rng = np.random.default_rng(0)
    np.savez(depths, depths=np.exp(rng.normal(0, 1.5, (24, 72, 96))))
    with pytest.raises(captures.CaptureError, match=r"static points .* more than 30%"):
        record.gather(with_files(depths=depths))


def test_a_capture_cut_to_some_frames_keeps_what_was_given_for_them(tmp_path):
    path, _ = tapir(tmp_path / "t.npz")
    capture = with_files(tracks=path)
    part = captures.select(capture, np.arange(3, 9))
    np.testing.assert_array_equal(
        part.external.track_pixel, capture.external.track_pixel[3:9]
    )
    assert dataclasses.replace(part, external=None).external is None
