"""Images that mean what they show: colors decoded by hand, sizes, hard inputs."""

import sys

import matplotlib
import numpy as np
import pytest
import skimage.io

from nerfies_jax.capture import extras
from nerfies_jax.visualization import panels

GRAY = (128, 128, 128)


def mapped(name, value):
    return np.round(255 * np.array(matplotlib.colormaps[name](int(value))[:3]))


@pytest.mark.hard_cases
def test_one_stray_depth_does_not_flatten_the_image(rng):
    depth = rng.uniform(2, 4, (3, 40, 40))
    depth[0, 0, 0] = 1e6
    colored = panels.color_depth(depth)
    assert 2 <= colored.low < colored.high <= 4
    np.testing.assert_array_equal(colored.image[0, 0, 0], mapped("viridis", 0))


@pytest.mark.hard_cases
@pytest.mark.parametrize("unknown", [np.nan, np.inf, -np.inf, 0.0, -1.0])
def test_unknown_depth_is_gray_and_a_flat_one_has_one_color(unknown):
    depth = np.full((4, 5), 3.0)
    depth[1, 2] = unknown
    known = np.ones((4, 5), bool)
    known[3, 3] = False
    image = panels.color_depth(depth, known).image
    assert tuple(image[1, 2]) == tuple(image[3, 3]) == GRAY
    assert len(np.unique(image.reshape(-1, 3), axis=0)) == 2
    nothing = panels.color_depth(np.full((4, 5), unknown)).image
    assert np.all(nothing == 128)


def test_error_is_linear_up_to_its_largest():
    truth = np.zeros((1, 4, 3), np.uint8)
    render = np.array([[[0, 0, 0], [0.3, 0, 0], [0.2, 0.2, 0.2], [1, np.nan, 0]]])
    image = panels.color_error(render, truth, largest=0.2).image[0]
    for column, index in ((0, 0), (1, 128), (2, 255)):
        np.testing.assert_array_equal(image[column], mapped("inferno", index))
    assert tuple(image[3]) == GRAY
    with pytest.raises(ValueError, match="largest=0 must be positive"):
        panels.color_error(render, truth, 0)


def test_flow_is_white_at_rest_and_hue_tells_the_direction():
    flow = np.array([[[0, 0], [4, 0], [-9, 0], [2, 0], [np.nan, 0]]], float)
    image = panels.color_flow(flow, largest=4.0).image[0]
    expected = [(255, 255, 255), (255, 0, 0), (0, 255, 255), (255, 128, 128), GRAY]
    np.testing.assert_array_equal(image, expected)
    still = panels.color_flow(np.zeros((2, 3, 2)))
    assert np.all(still.image == 255)
    assert panels.color_flow(np.full((2, 3, 2), np.nan)).high == 1


def test_a_comparison_holds_every_panel_unchanged(rng):
    truth = rng.integers(0, 256, (2, 30, 240, 3), dtype=np.uint8)
    render = rng.random((2, 30, 240, 3))
    depth = rng.uniform(1, 2, (2, 30, 240))
    image = panels.comparison(truth, render, depth, ["frame 3", "frame 9"])
    gap, text = panels.GAP, panels.TEXT_HEIGHT
    top = gap + 2 * (text + gap)
    for row in range(2):
        panel = image[top : top + 30]
        np.testing.assert_array_equal(panel[:, gap : gap + 240], truth[row])
        second = panel[:, 2 * gap + 240 : 2 * gap + 480]
        np.testing.assert_array_equal(second, panels.as_bytes(render[row]))
        top += 30 + gap + text + gap
    # Titles and captions are written, and differ.
    strips = [image[gap + i * (text + gap) :][:text, :300] for i in range(2)]
    assert all(strip.min() < 128 for strip in strips)
    assert not np.array_equal(*strips)


def test_small_frames_are_enlarged_by_whole_pixels(rng):
    truth = rng.integers(0, 256, (1, 5, 100, 3), dtype=np.uint8)
    image = panels.comparison(truth, truth, np.ones((1, 5, 100)), ["one"])
    gap, text = panels.GAP, panels.TEXT_HEIGHT
    panel = image[gap + 2 * (text + gap) :][: 3 * 5, gap : gap + 3 * 100]
    np.testing.assert_array_equal(panel, truth[0].repeat(3, 0).repeat(3, 1))


def test_a_comparison_refuses_unpaired_rows():
    frames = np.zeros((2, 5, 5, 3))
    with pytest.raises(ValueError, match="for each row, got 2, 2, 2 and 1"):
        panels.comparison(frames, frames, frames[..., 0], ["one"])


def test_a_contact_sheet_fills_rows_and_leaves_paper(rng):
    cells = list(rng.integers(0, 200, (5, 20, 240, 3), dtype=np.uint8))
    sheet = panels.contact_sheet(cells, [str(i) for i in range(5)], columns=3)
    gap, text = panels.GAP, panels.TEXT_HEIGHT
    step = 20 + gap + text + gap
    assert sheet.shape == (2 * step + gap, 3 * (240 + gap) + gap, 3)
    for i, cell in enumerate(cells):
        top, left = gap + i // 3 * step, gap + i % 3 * (240 + gap)
        np.testing.assert_array_equal(sheet[top : top + 20, left : left + 240], cell)
    assert np.all(sheet[gap + step :, gap + 2 * (240 + gap) :] == 255)
    with pytest.raises(ValueError, match="5 images and 1 captions"):
        panels.contact_sheet(cells, ["a"])


def test_the_curve_is_an_image_with_a_line_for_each_history(tmp_path):
    path = tmp_path / "psnr.png"
    one = panels.History([0, 1, 2], [20, np.nan, 25])
    panels.curve({"one": one}, path)
    first = skimage.io.imread(path)
    panels.curve({"one": one, "two": panels.History([0, 2], [18, 22])}, path)
    second = skimage.io.imread(path)
    panels.curve({"one": one}, path, panels.Final(2.0, 24.0, frames=9, watched=4))
    marked = skimage.io.imread(path)[..., :3].astype(int)
    orange = np.abs(marked - (0xC2, 0x41, 0x0C)).max(axis=-1) < 8
    assert orange.sum() > 100  # the mark and its number
    assert first.shape[1] == 936
    assert (second[..., :3] != first[..., :3]).any()
    assert [p.name for p in tmp_path.iterdir()] == ["psnr.png"]
    with pytest.raises(ValueError, match="no evaluations to plot"):
        panels.curve({"one": panels.History([], [])}, path)


def test_drawing_leaves_no_figure_behind(tmp_path):
    import matplotlib.pyplot

    panels.curve({"one": panels.History([0], [20])}, tmp_path / "psnr.png")
    assert matplotlib.pyplot.get_fignums() == []


def test_colors_are_matplotlibs_and_only_the_curve_needs_it(tmp_path, monkeypatch):
    ramp = np.linspace(0, 1, 256)[None]
    truth = np.zeros((1, 256, 3))
    error = panels.color_error(truth + ramp[..., None], truth, 1.0).image
    np.testing.assert_array_equal(error[0], [mapped("inferno", i) for i in range(256)])
    depth = panels.color_depth(2 - ramp, limits=(1.0, 2.0)).image
    np.testing.assert_array_equal(depth[0], [mapped("viridis", i) for i in range(256)])
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(extras.MissingExtra, match=r"matplotlib.*nerfies-jax\[report\]"):
        panels.curve({"one": panels.History([0], [20])}, tmp_path / "psnr.png")
