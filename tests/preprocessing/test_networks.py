"""Networks in ONNX files, written here, are run as their files and settings say."""

import dataclasses
import importlib.util
import json
import os

import numpy as np
import pytest

from nerfies_jax.capture import decoder
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.external import ExternalFiles
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.preprocessing import external_files, networks
from nerfies_jax.preprocessing.networks import NetworkSettings
from tests.preprocessing import two_planes

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
helper, numpy_helper, TensorProto = onnx.helper, onnx.numpy_helper, onnx.TensorProto
WIDTH, HEIGHT = two_planes.SIZE
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


@pytest.fixture(scope="module", autouse=True)
def children():
    """One child for all requests, and one for all streams."""
    with decoder.session():
        yield


@pytest.fixture(scope="module")
def capture():
    capture = two_planes.make(frames=4, points=0)
    return dataclasses.replace(capture, train=np.arange(3), heldout=np.array([3]))


def save(path, nodes, initializers=(), shape=(1, 3, HEIGHT, WIDTH), **options):
    """Write a network from input "x" to output "y"."""
    kind = options.pop("in_kind", TensorProto.FLOAT)
    inputs = [helper.make_tensor_value_info("x", kind, shape)]
    for name in options.pop("more_inputs", ()):
        inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]))
    output = helper.make_tensor_value_info(
        "y", options.pop("out_kind", TensorProto.FLOAT), None
    )
    graph = helper.make_graph(nodes, "net", inputs, [output], [*initializers])
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("custom", 1)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8)
    for key, value in options.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    path.write_bytes(model.SerializeToString())
    return path


def mixes(path, weight, bias=None, **options):
    """A network whose outputs are sums of the channels, [outputs, 3]."""
    weight = np.float32(weight)[:, :, None, None]
    bias = np.zeros(len(weight), np.float32) if bias is None else np.float32(bias)
    parts = [numpy_helper.from_array(weight, "w"), numpy_helper.from_array(bias, "b")]
    node = helper.make_node("Conv", ["x", "w", "b"], ["y"])
    return save(path, [node], parts, **options)


def normalized(capture, channel, mean=MEAN, std=STD):
    value = capture.images[:3, ..., channel] / 255
    return (value - mean[channel]) / std[channel]


def shifted(depth):
    return depth - np.minimum(0, depth.min((1, 2), keepdims=True))


LAYOUTS = ("fixed", "any size", "sidecar", "transformers", "metadata", "bytes last")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_image_is_normalized_as_the_files_say(tmp_path, capture, layout):
    path, expected, atol = tmp_path / "net.onnx", normalized(capture, 0), 1e-5
    red = [[1, 0, 0]]
    if layout == "fixed":
        mixes(path, red)
    elif layout == "any size":
        mixes(path, red, shape=(1, 3, "h", "w"))
        atol = 0.6  # resampled twice
    elif layout == "sidecar":
        mixes(path, red)
        own = {"mean": [0, 0, 0], "std": [1, 1, 1], "order": "bgr"}
        path.with_suffix(".json").write_text(json.dumps(own))
        expected = capture.images[:3, ..., 2] / 255
    elif layout == "transformers":
        (tmp_path / "onnx").mkdir()
        path = mixes(tmp_path / "onnx" / "model.onnx", red)
        stored = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "resample": 3}
        file = tmp_path / "preprocessor_config.json"
        file.write_text(json.dumps(stored | {"rescale_factor": 1 / 255}))
        half = np.full(3, 0.5)
        expected = normalized(capture, 0, half, half)
    elif layout == "metadata":
        mixes(path, red, mean="[0, 0, 0]", std="[1, 1, 1]", kind_of="x", author="me")
        expected = capture.images[:3, ..., 0] / 255
    else:
        last = (1, HEIGHT, WIDTH, 3)
        nodes = [
            helper.make_node("Cast", ["x"], ["f"], to=TensorProto.FLOAT),
            helper.make_node("ReduceMax", ["f"], ["y"], axes=[3], keepdims=0),
        ]
        save(path, nodes, shape=last, in_kind=TensorProto.UINT8)
        expected = capture.images[:3].max(-1).astype(float)
    depths = networks.depths(capture, path, folder=tmp_path / "cache")
    np.testing.assert_allclose(depths.depth[:3], shifted(expected), atol=atol)
    assert np.isnan(depths.depth[3]).all()  # held out
    assert depths.inverse is None


def test_results_are_cached_and_attached_with_their_kind(
    tmp_path, capture, monkeypatch
):
    path = mixes(tmp_path / "n.onnx", [[1, 1, 1]], kind="inverse depth")
    files = ExternalFiles(depth_model=path)
    first = external_files.attached(capture, files, tmp_path / "cache").external
    assert first.inverse is True
    monkeypatch.setattr(networks, "_results", None)
    again = external_files.attached(capture, files, tmp_path / "cache").external
    np.testing.assert_array_equal(first.depth, again.depth)
    brighter = dataclasses.replace(capture, images=capture.images // 2)
    with pytest.raises(TypeError):  # computed again
        external_files.attached(brighter, files, tmp_path / "cache")
    with pytest.raises(ValueError, match=r"depths=.* and depth_model=.*: both provide"):
        ExternalFiles(depths=path, depth_model=path)


@pytest.mark.parametrize("output", ["logits", "probability", "two", "classes"])
def test_segmentation_is_read_from_any_kind_of_output(tmp_path, capture, output):
    path, settings = tmp_path / "n.onnx", None
    middle = 0.5
    plain = {"mean": "[0, 0, 0]", "std": "[1, 1, 1]"}
    if output == "logits":
        mixes(path, [[10, 0, 0]], [-10 * middle], **plain)
    elif output == "probability":
        mixes(path, [[1, 0, 0]], **plain)
    elif output == "two":  # background and foreground
        mixes(path, [[-4, 0, 0], [4, 0, 0]], [4 * middle, -4 * middle], **plain)
    else:
        mixes(path, [[0, 0, 0], [1, 0, 0], [0, 0, 0]], [middle, 0, -9], **plain)
        with pytest.raises(CaptureError, match=r"3 classes; name those that move"):
            networks.segments(capture, path, folder=tmp_path)
        settings = NetworkSettings(mean=(0.0,) * 3, std=(1.0,) * 3, classes=(1,))
    masks = networks.segments(capture, path, settings, tmp_path / "cache")
    red = capture.images[:3, ..., 0] / 255
    expected = red > middle
    clear = abs(red - middle) > 0.01
    np.testing.assert_array_equal(masks[:3][clear], expected[clear])
    assert not masks[3].any()
    if output == "logits":
        files = ExternalFiles(segmentation_model=path)
        attached = external_files.attached(capture, files, tmp_path / "cache")
        np.testing.assert_array_equal(attached.external.moving, masks)
        assert "segmented by a network" in attached.notes[-1]


def outside(path, location):
    """A network whose weights are in another file."""
    weight = TensorProto(name="w", data_type=1, dims=[1, 3, 1, 1])
    weight.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "12")):
        entry = weight.external_data.add()
        entry.key, entry.value = key, value
    return save(path, [helper.make_node("Conv", ["x", "w"], ["y"])], [weight])


def test_weights_are_read_from_the_folder_of_the_network_only(tmp_path, capture):
    folder = tmp_path / "models"
    folder.mkdir()
    for place in (tmp_path, folder):
        np.float32([1, 0, 0]).tofile(place / "w.bin")
    os.symlink("../w.bin", folder / "link.bin")
    path = outside(folder / "n.onnx", "w.bin")
    depths = networks.depths(capture, path, folder=tmp_path / "cache")
    expected = shifted(normalized(capture, 0))
    np.testing.assert_allclose(depths.depth[:3], expected, atol=1e-5)
    for location in ("../w.bin", str(tmp_path / "w.bin"), "link.bin", "none.bin"):
        outside(path, location)
        with pytest.raises(CaptureError, match=r"n\.onnx: ONNX Runtime cannot use it"):
            networks.depths(capture, path, folder=tmp_path / "cache")


def test_what_is_no_network_of_an_image_is_refused(tmp_path, capture, monkeypatch):
    path, own = tmp_path / "n.onnx", tmp_path / "n.json"

    def refused(words, run=networks.depths):
        with pytest.raises(CaptureError, match=words):
            run(capture, path, folder=tmp_path / "cache")

    refused(r"n\.onnx: no such file of a network")
    path.write_bytes(b"cut short")
    refused(r"n\.onnx: ONNX Runtime cannot use it \(.*export it again")
    whole = mixes(path, [[1, 0, 0]]).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused(r"ONNX Runtime cannot use it")
    save(path, [helper.make_node("Own", ["x"], ["y"], domain="custom")])
    refused(r"ONNX Runtime cannot use it \(.*Own")
    mixes(path, [[1, 0, 0]], more_inputs=["z"])
    refused(r"its inputs are x .*, z .*; expected one image")
    save(path, [helper.make_node("Relu", ["x"], ["y"])], shape=(1, 1, 8, 8))
    refused(r"its input x is tensor\(float\) \[1, 1, 8, 8\]; expected one color image")
    save(path, [helper.make_node("Relu", ["x"], ["y"])])
    refused(r"its output y has shape \(3, 72, 96\); expected one depth per pixel")
    mixes(path, [[0, 0, 0]])
    refused(r"depth of frame '000' is the same everywhere")
    mixes(path, [[np.nan, 0, 0]])
    refused(r"depth of frame '000' is not finite")
    side = numpy_helper.from_array(np.int64([2**17, 3, HEIGHT, WIDTH]), "n")
    save(path, [helper.make_node("Expand", ["x", "n"], ["y"])], [side])
    refused(r"ONNX Runtime cannot use it")  # 10 TB
    mixes(path, [[1, 0, 0]])
    own.write_text('{"mean": [1, 2]}')
    refused(r"n\.json: .*length 3")
    own.write_text('{"std": [1, 1, 0]}')
    refused(r"n\.json: std=.* must be positive")
    own.write_text('{"means": [1, 2, 3]}')
    refused(r"n\.json: 'means' is no setting; there are size, scale, mean")
    own.write_text('{"output": "z"}')
    refused(r"no output 'z'; it has y")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"nerfies-jax\[onnx\]"):
        networks.depths(capture, path, folder=tmp_path / "cache")


def test_a_network_that_finds_nothing_leaves_the_masks_to_the_tracks(tmp_path, capture):
    path = mixes(tmp_path / "n.onnx", [[0, 0, 0]], [-5])
    files = ExternalFiles(segmentation_model=path)
    result = external_files.attached(capture, files, tmp_path / "cache")
    assert result.external.moving is None
    assert "marks none of the pixels, and is not used" in result.notes[-1]
