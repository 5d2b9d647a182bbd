"""Masks of every encoding: 0 and 1, palettes, alpha, 16 bits; ambiguous ones."""

import re

import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture import frames, images, masks
from nerfies_jax.capture.capture import CaptureError

# The marked pixels of three frames; nothing is marked in the last.
WHITE = np.zeros((3, 8, 10), bool)
WHITE[0, 2:5, 3:8] = True
WHITE[1, 1:7, 5:9] = True
PHOTO = np.random.default_rng(0).integers(0, 256, (8, 10, 3), np.uint8)


def gray(low, high, kind=np.uint8):
    return lambda white: PIL.Image.fromarray(np.where(white, high, low).astype(kind))


def color(value):
    return lambda white: PIL.Image.fromarray(white[..., None] * np.uint8(value))


def palette(colors):
    def save(white):
        image = PIL.Image.fromarray(white.astype(np.uint8)).convert("L")
        image = PIL.Image.frombytes("P", image.size, image.tobytes())
        image.putpalette([channel for one in colors for channel in one])
        return image

    return save


def alpha(pixels):
    def save(white):
        colors = np.broadcast_to(np.uint8(pixels), (*white.shape, 3))
        opaque = white[..., None] * np.uint8(255)
        return PIL.Image.fromarray(np.concatenate([colors, opaque], -1))

    return save


def instances(white):
    labels = white.astype(np.uint8)
    labels[:, 6:] *= 3
    return PIL.Image.fromarray(labels)


def soft(white):
    """Gray in between at the edges, as a resized mask has."""
    return PIL.Image.fromarray(white.astype(np.uint8) * 255).resize((20, 16))


ENCODINGS = {
    "0 and 255": (gray(0, 255), "values 0 and 255"),
    "0 and 1": (gray(0, 1), r"values 0 and 1 \(white\)"),
    "0 and 128": (gray(0, 128), "values 0 and 128"),
    "video range": (gray(16, 235), "white from 128 on"),
    "one bit": (PIL.Image.fromarray, "values 0 and 255"),
    "16 bits": (gray(0, 65535, np.uint16), "values 0 and 65535"),
    "16 bits of 0 and 255": (gray(0, 255, np.uint16), "values 0 and 255"),
    "16 bits of 0 and 1": (gray(0, 1, np.uint16), "values 0 and 1"),
    "equal channels of 0 and 1": (color((1, 1, 1)), "values 0 and 1"),
    "equal channels": (color((255, 255, 255)), "values 0 and 255"),
    "red": (color((255, 0, 0)), "values 0 and 255"),
    "palette of DAVIS": (palette([(0, 0, 0), (128, 0, 0)]), "values 0 and 128"),
    "palette of 0 and 1": (palette([(0, 0, 0), (1, 1, 1)]), "values 0 and 1"),
    "instances": (instances, "labels 0, 1, 3; all but 0"),
    "white with alpha": (alpha((255, 255, 255)), "alpha, opaque"),
    "photo with alpha": (alpha(PHOTO), "alpha, opaque"),
}


def save_all(folder, save, white=WHITE):
    paths = []
    for row, mask in enumerate(white):
        paths.append(folder / f"{row}.png")
        save(mask).save(paths[-1])
    return paths


@pytest.mark.parametrize("kind", ENCODINGS)
def test_every_encoding_says_what_is_white(tmp_path, kind):
    save, text = ENCODINGS[kind]
    paths = save_all(tmp_path, save)
    share, notes = frames.read_masks(paths, (10, 8), 1, "moving")
    np.testing.assert_array_equal(share == 1, WHITE)
    black = f"{1 - WHITE.mean():.1%} of their pixels are black: moving"
    assert f"3 masks of {masks.find_encoding(paths).text}; {black}" == notes[0]
    assert re.search(text, notes[0])
    inverse = masks.find_encoding(save_all(tmp_path, save, ~WHITE))
    np.testing.assert_array_equal(masks.read_mask(paths[2], inverse), ~WHITE[2])


def test_gray_edges_are_halved(tmp_path):
    paths = save_all(tmp_path, soft)
    share, notes = frames.read_masks(paths, (10, 8), 2, "moving")
    assert "gray values, white from 128 on" in notes[0]
    assert np.abs((share > 0.5) ^ WHITE).mean() < 0.02


def test_inverted_palettes_are_read_by_their_colors(tmp_path):
    paths = save_all(tmp_path, palette([(255, 255, 255), (0, 0, 0)]))
    share, _ = frames.read_masks(paths, (10, 8), 1, "moving")
    np.testing.assert_array_equal(share == 0, WHITE)


REFUSED = {
    "black with alpha": (alpha((0, 0, 0)), "either could be the mask"),
    "two colors without black": (
        palette([(68, 1, 84), (253, 231, 37)]),
        "without any black",
    ),
    "a photo": (lambda _: PIL.Image.fromarray(PHOTO), "a mask in color without"),
    "labels and void": (
        lambda white: PIL.Image.fromarray(
            np.where(white, 255, np.arange(10) % 3).astype(np.uint8)
        ),
        "neither black and white",
    ),
    "never black or white": (gray(1, 2), "neither black and white"),
    "all black": (gray(0, 0), "every pixel of all 3 masks is black"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_could_be_read_in_two_ways_is_refused(tmp_path, kind):
    save, message = REFUSED[kind]
    with pytest.raises(CaptureError, match=message) as caught:
        frames.read_masks(save_all(tmp_path, save), (10, 8), 1, "moving")
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_of_a_set_must_agree(tmp_path):
    paths = save_all(tmp_path, gray(0, 255))
    gray(0, 1)(WHITE[0]).save(paths[0])
    with pytest.raises(CaptureError, match=r"0\.png: a mask of 0 and 1 among masks"):
        masks.find_encoding(paths)
    gray(0, 255, np.uint16)(WHITE[0]).save(paths[0])
    with pytest.raises(CaptureError, match=r"(16|8) bits among"):
        masks.find_encoding(paths)
    alpha((255, 255, 255))(WHITE[0]).save(paths[0])
    with pytest.raises(CaptureError, match="without alpha channel among"):
        masks.find_encoding(paths)


def test_missing_and_white_masks_are_said(tmp_path):
    paths = save_all(tmp_path, gray(0, 255), ~np.zeros_like(WHITE))
    _, notes = frames.read_masks([*paths, None], (10, 8), 1, "not observed")
    assert notes[0] == (
        "3 of 4 masks of the one value 255; no pixel is black, so none is not observed"
    )


def test_masks_may_be_a_whole_multiple_of_the_images(tmp_path):
    paths = save_all(tmp_path, gray(0, 255))
    share, _ = frames.read_masks(paths, (5, 4), 1, "moving")
    blocks = WHITE.reshape(-1, 4, 2, 5, 2).mean((2, 4))
    np.testing.assert_allclose(share, blocks)
    with pytest.raises(
        CaptureError, match="the sizes must agree, or that of the mask be"
    ):
        frames.read_masks(paths, (7, 4), 1, "moving")


def test_masks_are_turned_with_their_images(tmp_path):
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    path = tmp_path / "a.png"
    gray(0, 1)(WHITE[0]).save(path, exif=exif)
    with pytest.raises(CaptureError, match="EXIF orientation"):
        masks.read_mask(path)
    turned = masks.read_mask(path, orientation="upright")
    np.testing.assert_array_equal(turned, np.rot90(WHITE[0], -1))
    images.write_png(path, WHITE[0])
    np.testing.assert_array_equal(masks.read_mask(path), WHITE[0])
