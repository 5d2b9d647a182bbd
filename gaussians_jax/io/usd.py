"""OpenUSD text files with a ParticleField3DGaussianSplat (usdVol, OpenUSD 26.03)."""

from typing import Literal

import numpy as np

from gaussians_jax.core.splats import Splats
from gaussians_jax.io.activated import activate

SUFFIX = ".usda"


def encode(rows: Splats, up: Literal["Y", "Z"] = "Y") -> bytes:
    """Encode Gaussians as one prim of a stage.

    Args:
      rows: Raw parameters of active Gaussians, finite, in NumPy.
      up: Axis that the stage names as up.

    Returns:
      The file. It calls a unit of length a meter, as nothing else is known.
    """
    values = activate(rows)
    degree = round(values.harmonics.shape[1] ** 0.5) - 1
    # As far as a Gaussian is drawn at all.
    reach = 3 * values.scale.max(axis=1, keepdims=True)
    low = (values.mean - reach).min(axis=0)
    high = (values.mean + reach).max(axis=0)
    opacities = ", ".join(f"{value:.9g}" for value in values.opacity)
    lines = [
        "#usda 1.0",
        "(",
        '    defaultPrim = "Gaussians"',
        "    metersPerUnit = 1",
        f'    upAxis = "{up}"',
        ")",
        "",
        'def ParticleField3DGaussianSplat "Gaussians"',
        "{",
        f"    float3[] extent = [{_tuples(np.stack([low, high]))}]",
        f"    point3f[] positions = [{_tuples(values.mean)}]",
        f"    quatf[] orientations = [{_tuples(values.quaternion)}]",
        f"    float3[] scales = [{_tuples(values.scale)}]",
        f"    float[] opacities = [{opacities}]",
        f"    uniform int radiance:sphericalHarmonicsDegree = {degree}",
        "    float3[] radiance:sphericalHarmonicsCoefficients = "
        f"[{_tuples(values.harmonics.reshape(-1, 3))}]",
        "}\n",
    ]
    return "\n".join(lines).encode()


def _tuples(values):
    """Format the rows of an array, with the digits of float32."""
    form = f"({', '.join(['%.9g'] * values.shape[1])})"
    return ", ".join(form % tuple(row) for row in values.tolist())
