"""OpenUSD text files with a ParticleField3DGaussianSplat (usdVol, OpenUSD 26.03)."""

from typing import Any, Literal

import numpy as np

from gaussians_jax.core.splats import LOG_SCALE_RANGE, Splats

SUFFIX = ".usda"


def encode(rows: Splats, up: Literal["Y", "Z"] = "Y") -> bytes:
    """Encode Gaussians as one prim of a stage.

    Args:
      rows: Raw parameters of active Gaussians, finite, in NumPy.
      up: Axis that the stage names as up.

    Returns:
      The file. It calls a unit of length a meter, as nothing else is known.
    """
    leaves: Any = (np.asarray(leaf, np.float64) for leaf in rows)
    rows = Splats(*leaves)
    length = np.linalg.norm(rows.quaternion, axis=1, keepdims=True)
    unit = np.where(length > 0, rows.quaternion / np.where(length > 0, length, 1), 0)
    unit[length[:, 0] == 0] = [1, 0, 0, 0]
    scale = np.exp(np.clip(rows.log_scale, *LOG_SCALE_RANGE))
    opacity = 1 / (1 + np.exp(-np.clip(rows.opacity_logit, -700, 700)))
    coefficients = np.concatenate([rows.sh_dc, rows.sh_rest], axis=1)
    degree = round(coefficients.shape[1] ** 0.5) - 1
    # As far as a Gaussian is drawn at all.
    reach = 3 * scale.max(axis=1, keepdims=True)
    low, high = (rows.mean - reach).min(axis=0), (rows.mean + reach).max(axis=0)
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
        f"    point3f[] positions = [{_tuples(rows.mean)}]",
        f"    quatf[] orientations = [{_tuples(unit)}]",
        f"    float3[] scales = [{_tuples(scale)}]",
        f"    float[] opacities = [{', '.join(f'{value:.9g}' for value in opacity)}]",
        f"    uniform int radiance:sphericalHarmonicsDegree = {degree}",
        "    float3[] radiance:sphericalHarmonicsCoefficients = "
        f"[{_tuples(coefficients.reshape(-1, 3))}]",
        "}\n",
    ]
    return "\n".join(lines).encode()


def _tuples(values):
    """Format the rows of an array, with the digits of float32."""
    form = f"({', '.join(['%.9g'] * values.shape[1])})"
    return ", ".join(form % tuple(row) for row in values.tolist())
