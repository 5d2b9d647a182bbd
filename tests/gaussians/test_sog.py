"""SOG files: read here as PlayCanvas documents them, without code of the writer."""

import io
import json
import math
import zipfile

import jax
import numpy as np
import pytest
from PIL import Image

from gaussians_jax.io import files, sog
from tests.gaussians.test_files import opacities, same_rotation, some_splats


def decoded(path):
    """A SOG file, Gaussian by Gaussian. splat-transform 3.7 reads the same numbers."""
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        images = {
            name: Image.open(io.BytesIO(archive.read(name)))
            for name in archive.namelist()
            if name != "meta.json"
        }
    assert meta["version"] == 2
    assert all(image.format == "WEBP" for image in images.values())

    def pixel(part, i, file=0):
        image = images[meta[part]["files"][file]]
        return image.getpixel((i % image.width, i // image.width))

    rows = {name: [] for name in ("mean", "log_scale", "quaternion", "color")}
    rows |= {"opacity": [], "sh_rest": []}
    for i in range(meta["count"]):
        low, high = pixel("means", i, 0), pixel("means", i, 1)
        mean = []
        for axis in range(3):
            least, most = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
            n = least + (most - least) * (low[axis] + 256 * high[axis]) / 65535
            mean.append(math.copysign(math.exp(abs(n)) - 1, n))
        rows["mean"].append(mean)
        codes = pixel("scales", i)
        rows["log_scale"].append([meta["scales"]["codebook"][c] for c in codes[:3]])
        *three, tag = pixel("quats", i)
        three = [(c / 255 - 0.5) * math.sqrt(2) for c in three]
        three.insert(tag - 252, math.sqrt(max(0, 1 - sum(c * c for c in three))))
        rows["quaternion"].append(three)
        *codes, alpha = pixel("sh0", i)
        rows["color"].append([meta["sh0"]["codebook"][c] for c in codes])
        rows["opacity"].append(alpha / 255)
        if "shN" in meta:
            about = meta["shN"]
            size = {1: 3, 2: 8, 3: 15}[about["bands"]]
            first, second, *_ = pixel("shN", i, 1)
            label = first + 256 * second
            assert label < about["count"]
            image = images[about["files"][0]]
            assert image.width == 64 * size
            place = [(label % 64 * size + k, label // 64) for k in range(size)]
            rows["sh_rest"].append(
                [[about["codebook"][c] for c in image.getpixel(p)] for p in place]
            )
    return {name: np.array(values) for name, values in rows.items()}


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_a_sog_file_holds_the_gaussians_within_its_steps(degree, tmp_path):
    rows = some_splats(count=150, degree=degree)
    assert files.save(tmp_path / "a.sog", rows) == 150
    read = decoded(tmp_path / "a.sog")
    distance = np.linalg.norm(read["mean"][:, None] - np.asarray(rows.mean), axis=-1)
    order = distance.argmin(axis=1)
    assert len(set(order)) == 150
    rows = jax.tree.map(lambda leaf: np.asarray(leaf, float)[order], rows)
    squeezed = np.log1p(np.abs(rows.mean))
    np.testing.assert_allclose(
        np.log1p(np.abs(read["mean"])), squeezed, atol=2 * squeezed.max() / 65535
    )
    assert same_rotation(read["quaternion"], rows.quaternion).max() < 1e-4
    np.testing.assert_allclose(read["opacity"], *opacities(rows), atol=0.51 / 255)
    # 450 values, and 256 entries where they are dense.
    for name, values in (("log_scale", rows.log_scale), ("color", rows.sh_dc[:, 0])):
        error = np.abs(read[name] - values)
        assert error.max() < 0.02 * np.ptp(values)
        assert error.mean() < 0.002 * np.ptp(values)
    if degree:
        error = read["sh_rest"] - rows.sh_rest
        assert np.sqrt(np.mean(error**2)) < 0.01 * rows.sh_rest.std()


def test_equal_scenes_make_equal_sog_files(tmp_path):
    for name in ("a.sog", "b.sog"):
        files.save(tmp_path / name, some_splats())
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_a_large_palette_has_the_means_of_small_groups(monkeypatch):
    monkeypatch.setattr(sog, "MOST_PALETTE", 64)
    vectors = np.random.default_rng(0).normal(size=(1000, 2)) * [10, 1]
    labels, palette = sog._palette(vectors)
    assert len(palette) == 64
    error = vectors - palette[labels]
    # 64 cells that are about square, in an area of about 40 times 4.
    assert np.linalg.norm(error.std(axis=0)) < 0.1 * np.linalg.norm(vectors.std(axis=0))
    for entry in range(64):
        mean = vectors[labels == entry].mean(axis=0)
        np.testing.assert_allclose(palette[entry], mean, atol=1e-9)
