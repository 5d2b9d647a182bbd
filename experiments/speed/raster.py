"""The rasterizer's time, alone or next to another rasterizer on the same scene.

Times are medians of processor time in one process that sees one core, because the
machine may be shared. The other rasterizer is a script that is called as
`PYTHON SCRIPT --gaussians N --size WxH --scene FILE --json`. It writes the scene that
it renders to FILE and answers with `forward_ms` and `forward_backward_ms`.
"""

import dataclasses
import json
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

from nerfies_jax.runs import platform

# Those that the published comparison bounds, as GAUSSIANS@WIDTHxHEIGHT.
CASES = ("10000@256x256", "50000@480x270", "200000@800x800")
REPEATS = 7


def measure(cases: tuple[str, ...], reference: pathlib.Path | None) -> dict:
    """Time all cases in this process.

    Args:
      cases: Numbers of Gaussians and image sizes, as `CASES`.
      reference: Script of the other rasterizer, or None.

    Returns:
      The machine and one row for each case.
    """
    platform.start_jax("cpu", "one")
    from nerfies_jax.metrics import clock

    rows = [time_case(text, reference) for text in cases]
    return {"machine": clock.machine(), "rows": rows}


def parse_case(case: str) -> tuple[int, int, int]:
    """Parse a case such as 10000@256x256.

    Returns:
      Gaussians, width and height.

    Raises:
      ValueError: If it is not a case.
    """
    try:
        count, size = case.split("@")
        width, height = size.split("x")
        return int(count), int(width), int(height)
    except ValueError:
        raise ValueError(
            f"a case is GAUSSIANS@WIDTHxHEIGHT, as 10000@256x256; got {case!r}"
        ) from None


def compile_case(text: str, scene: dict) -> tuple:
    """Compile the rasterizer and its gradient for a scene.

    Args:
      text: The case.
      scene: Projected Gaussians, as `make_scene` draws them.

    Returns:
      Calls without arguments: forward, and forward and backward.
    """
    import jax
    import jax.numpy as jnp

    from gaussians_jax.splatting import raster
    from gaussians_jax.splatting.raster_spec import GSPLAT

    # The clamp of the other rasterizer.
    spec = dataclasses.replace(GSPLAT, alpha_max=0.999)
    size = parse_case(text)[1:]
    footprints = _footprints_of(scene, spec.alpha_threshold)
    colors = jnp.asarray(scene["colors"], jnp.float32)

    @jax.jit
    def forward(footprints, colors):
        return raster.rasterize(footprints, colors, size, spec)

    def loss(mean_px, whitening, opacity, colors, footprints):
        new_footprints = footprints._replace(
            mean_px=mean_px, whitening=whitening, opacity=opacity
        )
        image, transmittance = raster.rasterize(new_footprints, colors, size, spec)
        return jnp.sum(image) + jnp.sum(transmittance)

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))
    return (
        lambda: forward(footprints, colors),
        lambda: gradient(*footprints[:3], colors, footprints),
    )


def make_scene(count: int, width: int, height: int) -> dict:
    """Sample Gaussians, half uniform and half in four clusters, of about 6.5 px."""
    import numpy as np

    rng = np.random.default_rng(0)
    size = np.array([width, height])
    center = rng.random((4, 2))[rng.integers(0, 4, count)] * size
    cluster_samples = center + rng.normal(size=(count, 2)) * size * 0.06
    spread = rng.random((count, 2)) * size
    one, two = np.exp(rng.normal(0.3, 0.5, (2, count))) ** 2
    angle = rng.random(count) * np.pi
    cos, sin = np.cos(angle), np.sin(angle)
    covariance = [
        cos**2 * one + sin**2 * two + 0.3,
        cos * sin * (one - two),
        sin**2 * one + cos**2 * two + 0.3,
    ]
    return dict(
        means2d=np.where(rng.random((count, 1)) < 0.5, spread, cluster_samples),
        covs=np.stack(covariance, 1),
        depths=1 + 9 * rng.random(count),
        opacities=1 / (1 + np.exp(-2 * rng.normal(size=count))),
        colors=rng.random((count, 3)),
    )


def _footprints_of(scene: dict, alpha_threshold: float):
    """Footprints of a scene given by image covariances (px^2)."""
    import jax.numpy as jnp
    import numpy as np

    from gaussians_jax.splatting.projection import Footprints

    a, b, c = scene["covs"].astype(np.float64).T
    opacity = scene["opacities"].astype(np.float64)
    whitening = [np.sqrt(0.5 / a), b / a, np.sqrt(0.5 / (c - b * b / a))]
    reach = 2 * np.log(np.maximum(opacity / alpha_threshold, 1))
    extent = np.sqrt(reach[:, None] * np.stack([a, c], 1))
    fields = (
        scene["means2d"],
        np.stack(whitening, 1),
        opacity,
        scene["depths"],
        extent,
    )
    return Footprints(*(jnp.asarray(field, jnp.float32) for field in fields))


def median_ms(
    call: Callable[[], Any], now: Callable[[], float] = time.process_time
) -> float:
    """Measure the milliseconds of a call.

    Args:
      call: Function without arguments that returns arrays.
      now: Clock in seconds.

    Returns:
      The median of several calls after one that warms up.
    """
    import jax
    import numpy as np

    jax.block_until_ready(call())
    times = []
    for _ in range(REPEATS):
        start = now()
        jax.block_until_ready(call())
        times.append(1e3 * (now() - start))
    return float(np.median(times))


def _reference_times(script: pathlib.Path, text: str, scene_file: str) -> dict:
    """Time the other rasterizer on a scene."""
    count, size = text.split("@")
    command = [sys.executable, str(script), "--gaussians", count, "--size", size]
    command += ["--scene", scene_file, "--json"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode:
        raise ValueError(f"{script} failed on {text}: {answer.stderr.strip()[-300:]}")
    return json.loads(answer.stdout.strip().splitlines()[-1])


def time_case(text: str, reference: pathlib.Path | None) -> dict:
    """Time one case, between two runs of the other rasterizer where there is one."""
    import numpy as np

    theirs, scene = [], make_scene(*parse_case(text))
    if reference is not None:
        with tempfile.TemporaryDirectory() as folder:
            file = str(pathlib.Path(folder) / "scene.npz")
            theirs.append(_reference_times(reference, text, file))
            with np.load(file) as arrays:
                scene = {name: arrays[name] for name in arrays.files}
    forward, with_gradient = compile_case(text, scene)
    row: dict[str, Any] = {
        "case": text,
        "forward_ms": median_ms(forward),
        "forward_backward_ms": median_ms(with_gradient),
    }
    if reference is not None:
        with tempfile.TemporaryDirectory() as folder:
            file = str(pathlib.Path(folder) / "scene.npz")
            theirs.append(_reference_times(reference, text, file))
        for name in ("forward_ms", "forward_backward_ms"):
            row[f"reference_{name}"] = sum(times[name] for times in theirs) / 2
        row["ratio"] = row["forward_backward_ms"] / row["reference_forward_backward_ms"]
    return row
