"""What the numbers of a capture alone tell is wrong with it, whatever its format."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax.capture import formats, gate
from nerfies_jax.capture.capture import CaptureError, select
from tests.scenes import tiny_capture

UTM = (500_000.0, 4_649_776.0, 120.0)


def changed(**values):
    return dataclasses.replace(tiny_capture(), **values)


def with_cameras(capture=None, **values):
    capture = capture or tiny_capture()
    return dataclasses.replace(capture, cameras=capture.cameras._replace(**values))


def some_moving(rows):
    moving = np.zeros(tiny_capture().images.shape[:3], bool)
    moving[:, :rows] = True
    return moving


def problems(capture):
    return [one.problem for one in gate.findings(capture) if one.problem]


def turned(matrix, vector):
    return np.einsum("nij,nj->ni", matrix, vector).astype(np.float32)


def turned_world():
    """The scene in a world whose axes are not those of the first camera."""
    capture = changed(depths=None)
    turn = Rotation.from_euler("xyz", [50, 70, 30], degrees=True).as_matrix()
    turn, cameras = turn.astype(np.float32), capture.cameras
    position = capture.points.position @ turn.T
    return with_cameras(
        dataclasses.replace(capture, points=capture.points._replace(position=position)),
        camera_from_world=cameras.camera_from_world @ turn.T,
        position=cameras.position @ turn.T,
    )


def other_poses():
    cameras = turned_world().cameras
    rotation, position = cameras.camera_from_world, cameras.position
    back = rotation.swapaxes(1, 2)
    flip = np.diag(np.float32([1, -1, -1]))
    return {
        "axes are right, up, back .OpenGL.": (flip @ rotation, position),
        "rotations are from camera to world": (back, position),
        "positions are translations": (rotation, -turned(rotation, position)),
        "poses are the inverse": (back, -turned(rotation, position)),
    }


REASONS = (
    "axes are right, up, back .OpenGL.",
    "rotations are from camera to world",
    "positions are translations",
    "poses are the inverse",
)


@pytest.mark.parametrize("reason", REASONS)
def test_another_convention_of_poses_is_named(reason):
    assert problems(turned_world()) == []
    rotation, position = other_poses()[reason]
    wrong = with_cameras(turned_world(), camera_from_world=rotation, position=position)
    pattern = f"of the points fall .* if the .*{reason}"
    if reason.startswith("rotations"):  # a quarter of the points is seen even so
        assert re.search(pattern, problems(wrong)[0])
        return
    with pytest.raises(CaptureError, match=pattern):
        gate.checked(wrong)


def test_camera_positions_in_millimeters_are_named():
    cameras = tiny_capture().cameras
    far = with_cameras(
        changed(depths=None, scale=1.0, center=(0.0, 0.0, 0.0)),
        position=1000 * cameras.position,
    )
    assert any("millimeters" in one for one in problems(far))


@pytest.mark.parametrize("with_points", [True, False])
def test_intrinsics_of_larger_images_are_named(with_points):
    cameras = tiny_capture().cameras
    capture = changed() if with_points else changed(points=None, depths=None)
    for times, refused in ((4, False), (16, with_points)):
        larger = with_cameras(
            capture,
            focal_px=times * cameras.focal_px,
            principal_point_px=times * cameras.principal_point_px,
        )
        findings = [
            one for one in gate.findings(larger) if f"{times} times as" in one.problem
        ]
        assert findings
        assert any(one.refused for one in findings) == refused


def test_intrinsics_of_smaller_images_are_named():
    cameras = tiny_capture().cameras
    smaller = with_cameras(
        changed(depths=None),
        focal_px=cameras.focal_px / 3,
        principal_point_px=cameras.principal_point_px / 3,
    )
    assert any("0.333 times as large" in one for one in problems(smaller))


def test_a_tile_of_a_larger_image_is_no_problem():
    """Of images of 360x270 one of 40x30, whose principal point lies outside of it."""
    cameras = tiny_capture().cameras
    corner = np.float32([60.0, 120.0])
    tile = with_cameras(
        changed(depths=None),
        focal_px=9 * cameras.focal_px,
        principal_point_px=9 * cameras.principal_point_px - corner,
    )
    assert problems(tile) == []
    bare = dataclasses.replace(tile, points=None)
    assert "unless the images are tiles" in problems(bare)[0]


def test_impossible_lenses_are_refused_and_doubtful_ones_said():
    cameras = tiny_capture().cameras
    one = np.ones_like(cameras.focal_px)
    bare = changed(points=None, depths=None)
    with pytest.raises(CaptureError, match=r"0\.5 px .* 177 degrees: .* millimeters"):
        gate.checked(with_cameras(bare, focal_px=0.5 * one))
    assert "focal length seems" in problems(with_cameras(bare, focal_px=5 * one))[0]
    assert "larger images" in problems(with_cameras(bare, focal_px=1e4 * one))[0]
    aspect = problems(with_cameras(pixel_aspect=2 * one))[0]
    assert "7 frames have pixels that are not square" in aspect
    zoomed = with_cameras(
        bare, focal_px=cameras.focal_px * np.float32([1, 1, 1, 3, 1, 1, 1])
    )
    assert "unless it zooms" in problems(zoomed)[0]
    radial = np.zeros_like(cameras.radial)
    radial[:, 0] = -0.9
    assert "folds back" in problems(with_cameras(bare, radial=radial))[0]
    radial[:, 0] = -9
    with pytest.raises(CaptureError, match=r"folds back in .*fisheye"):
        gate.checked(with_cameras(bare, radial=radial))
    radial[:, 0] = 5
    assert "moves the corners" in problems(with_cameras(bare, radial=radial))[0]


def test_near_and_far_in_world_units_are_named():
    good = changed(scale=0.02, depths=None)
    assert problems(good) == []
    wrong = dataclasses.replace(good, near=50 * good.near, far=50 * good.far)
    with pytest.raises(
        CaptureError, match=r"in world units, so multiply them by 0\.02"
    ):
        gate.checked(wrong)


def test_positions_that_float32_cannot_hold_are_refused():
    capture = changed(depths=None)
    moved = np.float32(np.array(UTM) / 5)  # a million scene units are refused before
    points = capture.points._replace(position=capture.points.position + moved)
    far = with_cameras(
        dataclasses.replace(capture, points=points),
        position=capture.cameras.position + moved,
    )
    with pytest.raises(CaptureError, match="map coordinates are not centered"):
        gate.checked(dataclasses.replace(far, points=None))
    # Rounded to float32 by the program that wrote the file, whatever it was read with.
    world = np.float64(capture.cameras.position) / capture.scale + np.array(UTM)
    rounded = (world.astype(np.float32) - np.array(UTM)) * capture.scale
    center = dataclasses.replace(capture, center=UTM, points=None)
    assert problems(center) == []
    with pytest.raises(CaptureError, match=r"multiples of .* rounded to float32"):
        gate.checked(with_cameras(center, position=rounded.astype(np.float32)))


def test_points_that_were_rounded_to_float32_are_said():
    capture = changed(depths=None, center=UTM)
    world = np.float64(capture.points.position) / capture.scale + np.array(UTM)
    rounded = (world.astype(np.float32) - np.array(UTM)) * capture.scale
    points = capture.points._replace(position=rounded.astype(np.float32))
    assert problems(capture) == []
    (problem,) = problems(dataclasses.replace(capture, points=points))
    assert problem.startswith("points are multiples of 0.25 world units")


@pytest.mark.parametrize(
    "reason", ["axes are right, up, back", "poses are the inverse"]
)
def test_cameras_that_look_apart_are_said_without_points(reason):
    """On an orbit around the scene, which has no points."""
    rotations, positions = [], []
    for angle in np.linspace(0, 2, 8):
        turn = Rotation.from_euler("y", angle).as_matrix()
        rotations.append(turn.T)
        positions.append(turn @ (0.1 * angle, 0.2, -3.0))
    rotation, position = np.float32(rotations), np.float32(positions)
    capture = tiny_capture()
    orbit = dataclasses.replace(
        select(capture, np.arange(7)), points=None, depths=None, flow=None
    )

    def cameras(rotation, position):
        return with_cameras(
            orbit, camera_from_world=rotation[:7], position=position[:7]
        )

    assert problems(cameras(rotation, position)) == []
    flipped = np.diag(np.float32([1, -1, -1])) @ rotation
    wrong = flipped, position
    if reason.startswith("poses"):
        wrong = rotation.swapaxes(1, 2), -turned(rotation, position)
    (problem,) = problems(cameras(*wrong))
    assert reason in problem


def test_focal_lengths_alone_of_larger_images_are_said():
    cameras = tiny_capture().cameras
    larger = with_cameras(changed(depths=None), focal_px=8 * cameras.focal_px)
    assert any("for images 8 times as large" in one for one in problems(larger))


def test_images_that_use_few_of_their_values_are_said():
    dark = changed(images=tiny_capture().images // 16)
    assert "16-bit files may hold values" in problems(dark)[0]


def test_a_frame_that_sees_no_points_is_named():
    turn = tiny_capture().cameras.camera_from_world.copy()
    turn[3] = np.diag(np.float32([-1, 1, -1])) @ turn[3]
    (problem,) = problems(with_cameras(changed(depths=None), camera_from_world=turn))
    assert f"1 frames show no points ({tiny_capture().ids[3]})" in problem


def test_masks_that_leave_next_to_nothing_are_said():
    capture = tiny_capture()
    few = np.zeros(capture.images.shape[:3], bool)
    few[:, 0, 0] = True
    assert "0.08% of the pixels are observed" in problems(changed(valid=few))[-1]
    some = np.ones_like(few)
    some[capture.train[1]] = False
    name = capture.ids[capture.train[1]]
    assert f"1 frames ({name}) without" in problems(changed(valid=some))[-1]
    assert "may be inverted" in problems(changed(moving=~few))[-1]
    assert "moving everywhere" in problems(changed(moving=~some))[-1]


def test_masks_that_leave_nothing_static_together_are_refused():
    with pytest.raises(CaptureError, match="no observed pixel of the 6 train"):
        gate.checked(changed(valid=some_moving(10), moving=some_moving(12)))


@pytest.mark.parametrize(
    ("times", "problem"),
    [
        ([0, 0.01, 0.02, 0.03, 0.99, 1], "there are no frames during 96% of the time"),
        ([0, 0.2, 0.2, 0.2, 0.8, 1], "frames have the time of another frame"),
        ([0, 0.8, 0.2, 0.6, 0.4, 1], "times fall in"),
    ],
)
def test_doubtful_times_are_said(times, problem):
    capture = changed(times=np.float32([*times, 0]), flow=None)
    assert problem in problems(capture)[-1]
    apart = dataclasses.replace(capture, camera_ids=np.arange(7, dtype=np.int32))
    assert ("there are no frames" in problem) == bool(problems(apart))


def test_the_table_has_a_line_for_each_check_and_one_for_each_problem():
    lines = gate.table(tiny_capture())
    assert len(lines) == len(gate.findings(tiny_capture())) > 10
    one = np.ones_like(tiny_capture().cameras.focal_px)
    assert len(gate.table(with_cameras(pixel_aspect=2 * one))) == len(lines) + 1


@pytest.mark.full
@pytest.mark.parametrize(
    "name", ["backpack_clip", "nrnerf_bookshelf", "blender_lego_static"]
)
def test_nothing_is_found_in_good_captures(name, data_dir):
    assert problems(formats.load(data_dir / name)) == []
