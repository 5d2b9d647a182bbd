"""What a capture and the settings of a synthetic scene refuse, and in which words."""

import dataclasses

import jax
import numpy as np
import pytest

from nerfies_jax.capture import capture as capturing
from nerfies_jax.capture import structure_from_motion as mapping
from nerfies_jax.capture import video
from nerfies_jax.capture.capture import CaptureError, PointCloud
from nerfies_jax.capture.exr import write_exr
from nerfies_jax.capture.images import write_png
from nerfies_jax.capture.synthetic import motion, presets, shapes, texture, trace
from nerfies_jax.capture.synthetic.spec import Cameras, Specular, Transient
from nerfies_jax.geometry import camera
from tests.capture.test_capture import make
from tests.capture.test_flow import some_flow

FLOW = some_flow()
CUBE = presets.CUBE
NOWHERE = jax.device_put(np.zeros(3, np.float32))
SCENE = dataclasses.replace(presets.NON_RIGID, things=(presets.WALL, CUBE))


def spoilt(array, place, value):
    array = array.copy()
    array[place] = value
    return array


def one_camera(field, value):
    cameras = make().cameras
    leaf = spoilt(getattr(cameras, field), 2, value)
    return {"cameras": cameras._replace(**{field: leaf})}


def cloud(*positions, colors=None):
    places = np.array(positions, np.float64)
    count = len(places) if colors is None else colors
    return {"points": PointCloud(places, np.zeros((count, 3), np.uint8))}


def flow(**changes):
    return {"flow": FLOW._replace(**changes)}


def flow_at(name, place, value):
    return flow(**{name: spoilt(getattr(FLOW, name), place, value)})


BYTES = np.zeros((4, 4, 6, 3), np.uint8)
F32, I32 = np.float32, np.int32
TWICE = {"camera_ids": I32([0, 0, 1, 1])}
CAPTURES = [
    ({"ids": ("a", "b", "b", "c")}, "'b' appears 2 times"),
    ({"images": np.zeros((4, 4, 6, 3))}, "float64"),
    ({"images": BYTES[:3]}, "4 ids"),
    ({"images": BYTES[:, :0]}, "(4, 0, 6, 3)"),
    ({"valid": np.ones((4, 6, 4), bool)}, "(4, 6, 4)"),
    ({"moving": np.ones((4, 4, 6), np.uint8)}, "uint8"),
    ({"times": np.zeros(3, F32)}, "(3,)"),
    ({"times": F32([0, 0.5, 1, 1.5])}, "'f3' has time 1.5"),
    ({"times": F32([0, np.nan, 1, 1])}, "'f1' has time nan"),
    ({"near": 5.0}, "near = 5"),
    ({"near": 0.0}, "near = 0"),
    ({"far": np.inf}, "far = inf"),
    ({"scale": 0.0}, "scale = 0"),
    ({"center": (0.0, np.nan, 0.0)}, "nan"),
    ({"warp_ids": I32([0, 1, 2, -1])}, "'f3' has warp_id -1"),
    ({"camera_ids": I32([0, 2**30, 0, 0])}, "camera_id 1073741824"),
    ({"train": np.array([1, 4])}, "row 4"),
    ({"heldout": np.array([-1])}, "row -1"),
    ({"train": np.array([1, 1])}, "twice"),
    ({"train": np.array([1.0])}, "row numbers"),
    ({"train": np.array([], int)}, "no training frames"),
    ({"heldout": np.array([2])}, "'f2' is both"),
    (cloud([np.inf] * 3, [np.inf] * 3), "2 scene points"),
    (cloud([0.0] * 3, [0.0] * 3, colors=1), "(1, 3)"),
    ({"depths": spoilt(make().depths, (1, 0, 0), np.nan)}, "'f1' has 1"),
    (one_camera("position", np.nan), "camera 'f2': position"),
    (one_camera("radial", np.inf), "camera 'f2': radial"),
    (one_camera("focal_px", -3), "camera 'f2': focal_px"),
    (
        one_camera("camera_from_world", np.diag([1, 1, -1])),
        "camera 'f2': orientation is a reflection",
    ),
    (
        one_camera("camera_from_world", 2 * np.eye(3)),
        "camera 'f2': orientation is not orthonormal",
    ),
    ({"cameras": camera.take(make().cameras, np.arange(3))}, "one per frame"),
    ({"frames_per_second": 0.0}, "0 frames per second; expected a positive rate"),
    ({"frames_per_second": np.nan}, "nan frames per second"),
    ({"frames": 1, "train": np.array([0]), "heldout": np.array([], int)}, "2 views"),
    (flow(forward=FLOW.forward.astype(np.float16)), "forward flow is float16"),
    (
        flow(backward=some_flow(size=(5, 4)).backward),
        "backward flow is float32 of shape (4, 4, 5, 2); expected",
    ),
    (flow(forward_valid=FLOW.forward_valid.astype(np.uint8)), "forward flow is uint8"),
    (flow(next_row=np.arange(3)), "expected one row number"),
    (flow(next_row=np.arange(4.0)), "expected one row number"),
    (flow_at("next_row", 1, 4), "frame 'f1' leads to row 4 of 4"),
    (flow_at("previous_row", 2, -1), "frame 'f2' leads to row -1"),
    (flow_at("forward", (2, 1, 1, 0), np.nan), "forward flow of frame 'f2'"),
    (flow_at("backward", (3, 0, 0, 1), np.inf), "backward flow of frame"),
    (
        flow_at("backward_valid", (0, 2, 2), True),
        "backward flow of frame 'f0' is seen, but it leads to no other",
    ),
    (TWICE | {"flow": FLOW}, "'f1' leads to 'f2' of another camera"),
]


@pytest.mark.parametrize(("changes", "refusal"), CAPTURES)
def test_a_capture_that_cannot_be_right_is_refused_in_one_line(changes, refusal):
    with pytest.raises(CaptureError) as caught:
        make(**changes)
    message = str(caught.value)
    assert refusal in message
    assert message.startswith("test: ")
    assert "\n" not in message


REFUSED = [
    *(
        (
            lambda n=n: capturing.downscale(make(), n),
            "test: cannot downscale 6x4 images",
        )
        for n in (0, 5, -1)
    ),
    (lambda: dataclasses.replace(SCENE, frames=1), "frames=1 must be at least 2"),
    (lambda: dataclasses.replace(SCENE, size=(4, 40)), "at least 8x8"),
    (lambda: dataclasses.replace(SCENE, things=()), "at least one thing"),
    (lambda: dataclasses.replace(SCENE, things=(CUBE, CUBE)), "called 'cube'; rename"),
    (lambda: dataclasses.replace(SCENE, specular=Specular("moon")), "'moon' is not in"),
    (lambda: dataclasses.replace(SCENE, skip_every=1), "skip_every=1"),
    (lambda: dataclasses.replace(SCENE, ambient=2.0), "ambient=2.0"),
    (lambda: dataclasses.replace(SCENE, supersampling=0), "supersampling=0"),
    (lambda: Cameras(distance=0.1, forward=0.2), "forward=0.2"),
    (lambda: Cameras(field_of_view_rad=4.0), "field_of_view_rad=4.0"),
    (lambda: Cameras(shake=-1.0), "shake=-1.0"),
    (lambda: Transient(presets.PASSER, ((0.5, 0.4),)), r"window \(0.5, 0.4\)"),
    (lambda: SCENE.id_of("moon"), "no thing 'moon'"),
    (lambda: shapes.Sphere(0.0), "radius=0.0 must be positive"),
    (lambda: shapes.Box((1.0, -1.0, 1.0)), "half=-1.0 must be positive"),
    (lambda: shapes.Sheet(0.1, 0.1, sway=-1.0), "sway=-1.0"),
    (lambda: motion.Path(axis=(0.0, 0.0, 0.0)), "no direction"),
    (lambda: motion.Arm(()), "at least one hinge"),
    (lambda: motion.Glide((1.0, 0.0, 0.0), 0.5, 0.2), "start=0.5 and stop=0.2"),
    (lambda: texture.Texture(noise_size=0.0), "noise_size=0.0 must be positive"),
    (lambda: texture.Texture(dark=(0.0, 300.0, 0.0)), "divide 8-bit"),
    (lambda: trace.observe(SCENE, 99, NOWHERE, NOWHERE[0]), "thing 99"),
    (lambda: mapping.MappingSpec(features=1), "features=1 "),
    (lambda: mapping.MappingSpec(at_least=2.0), "at_least=2"),
    (lambda: write_exr("a.exr"), "at least one"),
    (
        lambda: write_exr("a.exr", F32(BYTES[0]), depth=F32(BYTES[0, 1:, :, 0])),
        "shapes",
    ),
    (lambda: write_exr("a.exr", F32(BYTES[0]) + 1e5, half=True), "half=False"),
    (lambda: write_exr("none/a.exr", F32(BYTES[0])), "cannot be written"),
    (lambda: write_png("a.png", BYTES[0] / 255), "float64"),
    (lambda: write_png("none/a.png", BYTES[0]), "cannot be written"),
    (lambda: video.write_video("a.mp4", []), "no frames"),
    (lambda: video.write_video("a.mp4", [BYTES[0]], 4e-4), "frames_per_second=0.0004"),
    (
        lambda: video.write_video("a.mp4", [BYTES[0], BYTES[0, :2, :2]]),
        r"frame 1 is uint8 of shape \(2, 2, 3\)",
    ),
    (lambda: video.write_video("none/a.mp4", [BYTES[0]]), "cannot be written"),
    (lambda: video.write_video("a.nonsense", [BYTES[0]]), "cannot be written"),
]


@pytest.mark.parametrize(("call", "words"), REFUSED)
def test_nonsense_is_refused_by_name_and_leaves_nothing(
    call, words, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=words):
        call()
    assert list(tmp_path.iterdir()) == []
