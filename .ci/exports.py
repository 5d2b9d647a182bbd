"""Export a run in every format and open each file with a reader of other projects.

    pip install -e '.[all]' usd-core trimesh pygltflib OpenImageIO
    npm install --no-save @playcanvas/splat-transform
    python .ci/exports.py RUN OUT

Needs a run of splats with a motion. Every export of Gaussians has the same ones in the
same axes, so that their means, opacities and number are compared with the PLY.
"""

import json
import pathlib
import subprocess
import sys

import numpy as np
import OpenImageIO
import plyfile
import pycolmap
import pygltflib
import trimesh
from pxr import Usd

# Quantization of positions, relative to the size of the scene.
STEP = 2e-3
CONVERTED = {"splat": "splat", "spz": "spz", "sog": "sog"}
CONVERTED |= {"compressed-ply": "compressed.ply"}


def export(run, out, kind, *options):
    """Export, and return the path."""
    command = [sys.executable, "-m", "experiments", "export", str(run), kind, *options]
    subprocess.run([*command, "--out", str(out), "--overwrite"], check=True)
    return out


def of_ply(path):
    """Means and opacities of a PLY of 3D Gaussian splatting."""
    vertex = plyfile.PlyData.read(path)["vertex"]
    mean = np.stack([vertex[axis] for axis in "xyz"], axis=-1)
    return mean, 1 / (1 + np.exp(-vertex["opacity"]))


def of_usd(path):
    """The same of a stage of OpenUSD."""
    stage = Usd.Stage.Open(str(path))  # a prim does not keep it
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    names = ("positions", "opacities")
    return tuple(np.array(prim.GetAttribute(name).Get()) for name in names)


def of_gltf(path):
    """The same of a binary glTF."""
    document = pygltflib.GLTF2().load(path)
    (primitive,) = document.meshes[0].primitives
    assert list(primitive.extensions) == ["KHR_gaussian_splatting"]
    names = vars(primitive.attributes)
    values = []
    for name, width in (("POSITION", 3), ("KHR_gaussian_splatting:OPACITY", 1)):
        accessor = document.accessors[names[name]]
        view = document.bufferViews[accessor.bufferView]
        values.append(
            np.frombuffer(
                document.binary_blob(), "<f4", accessor.count * width, view.byteOffset
            ).reshape(-1, width)
        )
    return values[0], values[1][:, 0]


def of_splat_transform(path, out):
    """The same of a format that PlayCanvas' splat-transform converts to PLY."""
    command = ["npx", "splat-transform", "-q", "-w", str(path), str(out)]
    subprocess.run(command, check=True)
    return of_ply(out)


def same(name, expected, read):
    """Compare Gaussians, which formats store in different orders."""
    assert len(read[0]) == len(expected[0]), (name, len(read[0]), len(expected[0]))
    size = np.ptp(expected[0], axis=0).max()
    for part, scale in ((0, size), (1, 1.0)):
        a, b = (np.sort(np.asarray(one[part]), axis=0) for one in (expected, read))
        error = np.abs(a - b).max() / scale
        assert error < STEP + (part and 1 / 255), (name, part, error)
    print(f"{name}: {len(read[0])} Gaussians")


def main(run, out):
    """Export, read and compare. An assertion names what differs."""
    run, out = pathlib.Path(run), pathlib.Path(out)
    out.mkdir(parents=True, exist_ok=True)
    up = ("--up", "y", "--keep", "seen")
    expected = of_ply(export(run, out / "a.ply", "ply", *up))
    same("usda", expected, of_usd(export(run, out / "a.usda", "usda", *up)))
    same("glb", expected, of_gltf(export(run, out / "a.glb", "glb", *up)))
    for kind, suffix in CONVERTED.items():
        path = export(run, out / f"a.{suffix}", kind, *up)
        mean, opacity = of_splat_transform(path, out / f"{kind}.ply")
        # SPZ has y up and z back, which splat-transform copies as they are.
        mean = mean * (np.array([1, -1, -1]) if kind == "spz" else 1)
        same(kind, expected, (mean, opacity))
    mesh = trimesh.load(export(run, out / "mesh.ply", "mesh", "--up", "y"))
    assert len(mesh.faces)
    assert mesh.visual.kind == "vertex"
    print(f"mesh: {len(mesh.faces)} triangles")
    model = pycolmap.Reconstruction(export(run, out / "colmap", "colmap") / "sparse/0")
    assert model.num_reg_images() > 0
    print(f"colmap: {model.num_reg_images()} images")
    transforms = json.loads(
        (export(run, out / "ns", "transforms") / "transforms.json").read_text()
    )
    assert all(
        (out / "ns" / one["file_path"]).is_file() for one in transforms["frames"]
    )
    print(f"transforms: {len(transforms['frames'])} frames")
    folder = export(run, out / "exr", "exr", "--frames", "2")
    images = sorted(folder.rglob("*.exr"))
    assert images
    for path in images:
        image = OpenImageIO.ImageInput.open(str(path))
        assert image is not None, (path, OpenImageIO.geterror())
        assert np.isfinite(image.read_image("float")).any()
        image.close()
    print(f"exr: {len(images)} images")


if __name__ == "__main__":
    main(*sys.argv[1:])
