"""PNG and JPEG of every kind, broken ones, and bombs."""

import struct
import zlib

import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture import exr, images, masks
from nerfies_jax.capture.capture import CaptureError

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (6, 9, 3), np.uint8)
ALPHA = RNG.integers(0, 256, (6, 9), np.uint8)


def save(path, pixels):
    PIL.Image.fromarray(pixels).save(path)
    return path


def test_color_and_gray(tmp_path):
    color, alpha = images.read_image(save(tmp_path / "a.png", COLOR))
    np.testing.assert_array_equal(color, COLOR)
    assert alpha is None
    color, alpha = images.read_image(save(tmp_path / "b.png", ALPHA))
    np.testing.assert_array_equal(color, np.repeat(ALPHA[..., None], 3, 2))
    assert alpha is None


def test_alpha_is_kept_apart(tmp_path):
    both = np.concatenate([COLOR, ALPHA[..., None]], -1)
    color, alpha = images.read_image(save(tmp_path / "a.png", both))
    np.testing.assert_array_equal(color, COLOR)
    np.testing.assert_array_equal(alpha, ALPHA)


def test_gray_with_alpha_is_not_transposed(tmp_path):
    # skimage.io.imread returns [width, 2, ...] for these.
    both = np.stack([COLOR[..., 0], ALPHA], -1)
    color, alpha = images.read_image(save(tmp_path / "a.png", both))
    np.testing.assert_array_equal(color[..., 1], COLOR[..., 0])
    np.testing.assert_array_equal(alpha, ALPHA)


def test_a_palette_is_looked_up(tmp_path):
    indices = RNG.integers(0, 4, (6, 9), np.uint8)
    palette = np.uint8([[10, 20, 30], [200, 100, 50], [0, 0, 255], [9, 9, 9]])
    image = PIL.Image.new("P", (9, 6))
    image.putdata(indices.ravel().tolist())
    image.putpalette(palette.ravel().tolist())
    image.save(tmp_path / "a.png")
    color, alpha = images.read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(color, palette[indices])
    assert alpha is None
    image.save(tmp_path / "b.png", transparency=2)
    color, alpha = images.read_image(tmp_path / "b.png")
    np.testing.assert_array_equal(color, palette[indices])
    np.testing.assert_array_equal(alpha == 0, indices == 2)


def test_one_bit_and_sixteen_bits(tmp_path):
    bits = ALPHA > 128
    save(tmp_path / "a.png", bits)
    np.testing.assert_array_equal(masks.read_mask(tmp_path / "a.png"), bits)
    deep = RNG.integers(0, 65536, (6, 9)).astype(np.uint16)
    images.write_png(tmp_path / "b.png", deep)
    color, _ = images.read_image(tmp_path / "b.png")
    np.testing.assert_array_equal(color[..., 0], np.round(deep / 257).astype(int))


@pytest.mark.parametrize("packing", [None, "tiff_lzw", "tiff_deflate"])
@pytest.mark.parametrize(
    ("stored", "read"),
    [
        (COLOR, COLOR),
        (ALPHA, ALPHA),
        (ALPHA > 128, np.where(ALPHA > 128, 255, 0)),
        (ALPHA * np.uint16(257), ALPHA),
    ],
)
def test_a_tiff_is_read_however_it_is_packed(tmp_path, stored, read, packing):
    PIL.Image.fromarray(stored).save(tmp_path / "a.tif", compression=packing)
    pixels = images.read_pixels(tmp_path / "a.tif").squeeze()
    np.testing.assert_array_equal(pixels, read)


def test_sixteen_bit_color_loses_at_most_its_low_byte(tmp_path):
    deep = RNG.integers(0, 65536, (6, 9, 3)).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in deep)
    write_png_by_hand(tmp_path / "a.png", (9, 6), 16, 2, rows)
    color, _ = images.read_image(tmp_path / "a.png")
    np.testing.assert_array_equal(color, deep >> 8)


def write_png_by_hand(path, size, depth, kind, rows):
    def chunk(name, data):
        check = zlib.crc32(name + data)
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", *size, depth, kind, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_a_turned_image_is_refused_or_read_as_stored(tmp_path, ending, orientation):
    image = PIL.Image.fromarray(COLOR)
    tags = image.getexif()
    tags[0x0112] = orientation
    image.save(
        tmp_path / f"a.{ending}",
        exif=tags,
        **{"quality": 95} if ending == "jpg" else {},
    )
    if orientation == 1:  # upright
        assert images.read_image(tmp_path / f"a.{ending}")[0].shape == (6, 9, 3)
        return
    with pytest.raises(CaptureError, match="orientation is 6"):
        images.read_image(tmp_path / f"a.{ending}")
    color, _ = images.read_image(tmp_path / f"a.{ending}", orientation="stored")
    assert color.shape == (6, 9, 3)


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("share", [0, 40, 0.95])
def test_an_image_cut_short_is_refused(tmp_path, ending, share):
    noise = RNG.integers(0, 256, (64, 64, 3), np.uint8)
    path = save(tmp_path / f"a.{ending}", noise)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data)) if share < 1 else int(share)])
    with pytest.raises(
        CaptureError, match=rf"a\.{ending}: not a readable image"
    ) as caught:
        images.read_image(path)
    assert "\n" not in str(caught.value)


def test_what_is_no_image_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no such image"):
        images.read_image(tmp_path / "a.png")
    (tmp_path / "b.png").write_text("hello")
    with pytest.raises(CaptureError, match="not a readable image"):
        images.read_image(tmp_path / "b.png")
    PIL.Image.fromarray(COLOR).convert("CMYK").save(tmp_path / "c.jpg")
    with pytest.raises(CaptureError, match="CMYK"):
        images.read_image(tmp_path / "c.jpg")


@pytest.mark.parametrize("side", [9_000, 20_000])
def test_a_bomb_is_refused_before_it_is_decoded(tmp_path, side):
    # A header that promises 81 or 400 million pixels over a few bytes: were it
    # decoded, the complaint would be about the data.
    write_png_by_hand(tmp_path / "a.png", (side, side), 8, 2, b"\0" * 100)
    with pytest.raises(CaptureError, match="more than 64000000"):
        images.read_image(tmp_path / "a.png")


def test_laying_over_a_background(tmp_path):
    pixels = images.over(COLOR, ALPHA, (1.0, 0.5, 0.0))
    cover = ALPHA[..., None] / 255
    exact = COLOR * cover + np.array([255, 127.5, 0]) * (1 - cover)
    assert np.abs(pixels - exact).max() <= 0.5 + 1e-4


def test_srgb_curves_are_the_standard_and_each_others_inverse():
    light = np.linspace(0, 1, 10_001)
    # IEC 61966-2-1, one number at a time
    known = [
        12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in light
    ]
    np.testing.assert_allclose(images.srgb_from_linear(light), known, atol=1e-12)
    # The published constants meet to 3e-8 only.
    back = images.linear_from_srgb(images.srgb_from_linear(light))
    np.testing.assert_allclose(back, light, atol=1e-7)
    assert images.srgb_from_linear(np.array([-1.0, 2.0])).tolist() == pytest.approx(
        [0, 1]
    )


def test_linear_light_is_read_as_the_colors_it_is_seen_as(tmp_path):
    light = images.linear_from_srgb(COLOR / 255)
    light[0, 0] = 3.0  # brighter than a screen
    exr.write_exr(tmp_path / "a.exr", light, alpha=np.ones(light.shape[:2]))
    assert images.read_header(tmp_path / "a.exr").size == (9, 6)
    color, alpha = images.read_image(tmp_path / "a.exr")
    expected = COLOR.copy()
    expected[0, 0] = 255
    np.testing.assert_array_equal(color, expected)
    assert alpha is None
    exr.write_exr(tmp_path / "b.exr", light, alpha=ALPHA / 255)
    with pytest.raises(CaptureError, match="has transparent pixels"):
        images.read_image(tmp_path / "b.exr")
    exr.write_exr(tmp_path / "c.exr", depth=light[..., 0])
    with pytest.raises(CaptureError, match="no color"):
        images.read_image(tmp_path / "c.exr")
    with pytest.raises(CaptureError, match="no such image"):
        images.read_header(tmp_path / "d.exr")
