"""Motion on cubics, in the file that antimatter15's viewer reads."""

import json
import math
import struct

import numpy as np
import pytest

from gaussians_jax.io import splatv
from gaussians_jax.io.keyframes import Keyframes
from tests import scenes

TIMES = np.linspace(0, 1, 25)


def learned():
    """Three Gaussians: on a cubic and turning, fading in and out, at rest."""
    u = TIMES - 0.5
    mean = np.zeros((25, 3, 3))
    mean[:, 0] = np.stack([0.3 + u - 2 * u**3, 1 - u**2, 0.5 * u + u**2], axis=1)
    mean[:, 1, 0] = 2 * (TIMES - 0.8)
    mean[:, 2] = 0.1, 0.2, 0.3
    turn = np.tile([1.0, 0, 0, 0], (25, 3, 1))
    turn[:, 0] = np.stack([np.ones(25), 0.3 * u, 0 * u, -0.1 * u], axis=1)
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    opacity = np.full((25, 3), 0.6)
    opacity[:, 1] = 0.8 * np.exp(-(((TIMES - 0.8) / 0.2) ** 2))
    return Keyframes(
        mean=mean.astype(np.float32),
        quaternion=turn.astype(np.float32),
        log_scale=np.full((25, 3, 3), math.log(0.05), np.float32),
        opacity=opacity.astype(np.float32),
        color=np.float32([[1.2, 0.5, 0], [0, 0, 1], [0.2, 0.2, 0.2]]),
        left_out=0,
    )


def test_what_moves_on_cubics_and_fades_by_bells_comes_back():
    keyframes, capture = learned(), scenes.tiny_capture()
    curves = splatv.decode(splatv.encode(splatv.fit(keyframes), capture))
    for row, time in enumerate(TIMES):
        gaussians = splatv.at(curves, float(time))
        seen = keyframes.opacity[row] > 0.02
        # Half floats of coefficients up to 2 over half a video, 8 bits of opacity
        off = np.abs(np.asarray(gaussians.mean) - keyframes.mean[row])
        assert off[seen].max() < 2e-3
        np.testing.assert_allclose(gaussians.opacity, keyframes.opacity[row], atol=4e-3)
        turn = np.asarray(gaussians.quaternion)
        turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        # 9 degrees to either side: the unit quaternion is off a line by 1e-3 at most
        np.testing.assert_allclose(turn, keyframes.quaternion[row], atol=2e-3)
    np.testing.assert_allclose(curves.scale, 0.05, rtol=1e-3)
    np.testing.assert_allclose(curves.color[0], [1, 128 / 255, 0], atol=1e-7)


def test_a_row_of_the_file_is_what_its_shader_unpacks():
    """By the viewer's own reading: sixteen words, halves in pairs, low one first."""
    capture = scenes.tiny_capture()
    curves = splatv.fit(learned())
    data = splatv.encode(curves, capture)
    magic, length = struct.unpack("<2I", data[:8])
    (about,) = json.loads(data[8 : 8 + length])
    texture = data[8 + length :]
    assert magic == 0x674B
    assert about["size"] == len(texture) == 16 * about["texwidth"] * about["texheight"]
    camera, row = about["cameras"][0], int(capture.train[0])
    turn = np.array(camera["rotation"])
    np.testing.assert_allclose(turn[:, 2], capture.cameras.camera_from_world[row, 2])
    index, time = 1, 0.7
    words = texture[64 * index : 64 * (index + 1)]
    halves = struct.unpack("<32e", words)
    x, y, z = struct.unpack("<3f", words[:12])
    center, width = halves[30:]
    since = time - center
    first, second, third = (np.array(halves[16 + 3 * k : 19 + 3 * k]) for k in range(3))
    mean = np.array([x, y, z]) + since * (first + since * (second + since * third))
    gaussians = splatv.at(curves, time)
    np.testing.assert_allclose(mean, gaussians.mean[index], atol=1e-3)
    turning = np.array(halves[26:30]) * since
    np.testing.assert_allclose(
        np.array(halves[6:10]) + turning, gaussians.quaternion[index], atol=1e-3
    )
    np.testing.assert_allclose(halves[10:13], 0.05, rtol=1e-3)
    alpha = words[31] / 255 * math.exp(-((since / width) ** 2))
    assert alpha == pytest.approx(float(gaussians.opacity[index]), abs=4e-3)
    # The rest of the texture draws nothing: a bell of no width.
    assert texture[64 * 3 :].count(0) == len(texture) - 64 * 3


def test_what_no_half_float_holds_is_refused():
    far = splatv.fit(learned())._replace(position=np.full((3, 3), 1e5))
    with pytest.raises(ValueError, match="position of 1e"):
        splatv.encode(far, scenes.tiny_capture())
    with pytest.raises(ValueError, match=r"not a \.splatv file"):
        splatv.decode(b"ply\nformat")
