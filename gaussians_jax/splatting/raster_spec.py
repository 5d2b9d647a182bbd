"""Settings of the rasterizer: thresholds, clamps, tiles, chunks of pairs."""

import dataclasses
from typing import Literal

TILE_SIZES = (4, 8, 16, 32)


@dataclasses.dataclass(frozen=True)
class RasterSpec:
    """Thresholds that define the image, and sizes that only affect speed and memory.

    `tile`, `capacity`, `batch`, `chunk` and `kept_chunks` never change the image beyond
    rounding. The others define it. The defaults are those of gsplat 1.6 (`GSPLAT`).
    `INRIA` is the original 3D Gaussian splatting (Kerbl et al. 2023, arXiv:2308.04079)
    as its public rasterizer runs.
    """

    alpha_threshold: float = 1 / 255  # smaller alphas are skipped
    alpha_max: float = 0.99  # upper bound of alpha
    clamp_gradient: Literal["zero", "through"] = "zero"  # above alpha_max
    transmittance_threshold: float = 1e-4  # a pixel is saturated before it falls below
    eps2d: float = 0.3  # px^2, added to both variances of the footprint
    antialiased: bool = False  # opacity times sqrt(det before / after dilation)
    near: float = 0.01  # z-depth, scene units
    far: float = 1e10
    tangent_margin: float = 0.3  # clamp of x/z, y/z in the Jacobian, in half images
    # Project through the radial and tangential distortion of the cameras. Without it,
    # the compiled program is that of a pinhole. A fisheye is recognized by its camera.
    distorted: bool = False
    tile: int = 8  # pixels along an edge
    capacity: int | None = None  # (tile, Gaussian) pairs per chunk; None: automatic
    batch: int | None = None  # tiles blended in lockstep; None: by backend
    chunk: int | None = None  # Gaussians blended in one step; None: by backend
    kept_chunks: int = 4  # sorted pairs to keep for the backward pass, 4 bytes each

    def __post_init__(self):
        if not 0 < self.alpha_threshold < self.alpha_max < 1:
            raise ValueError(
                "need 0 < alpha_threshold < alpha_max < 1, got "
                f"{self.alpha_threshold} and {self.alpha_max}; the backward pass "
                "divides by 1 - alpha"
            )
        if not 0 <= self.transmittance_threshold < 1:
            raise ValueError(
                "need 0 <= transmittance_threshold < 1, got "
                f"{self.transmittance_threshold}; 0 composites all Gaussians"
            )
        if not 0 < self.near < self.far:
            raise ValueError(f"need 0 < near < far, got {self.near} and {self.far}")
        if not self.eps2d > 0:
            raise ValueError(
                f"eps2d must be positive, got {self.eps2d}; without it a "
                "flat Gaussian seen edge-on has no inverse covariance"
            )
        if not self.tangent_margin >= 0:
            raise ValueError(f"tangent_margin must be >= 0, got {self.tangent_margin}")
        if self.clamp_gradient not in ("zero", "through"):
            raise ValueError(
                'clamp_gradient must be "zero" or "through", got '
                f"{self.clamp_gradient!r}"
            )
        if self.tile not in TILE_SIZES:
            raise ValueError(f"tile must be one of {TILE_SIZES}, got {self.tile}")
        for name in ("capacity", "batch", "chunk"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1 or None, got {value}")
        if self.kept_chunks < 1:
            raise ValueError(f"kept_chunks must be at least 1, got {self.kept_chunks}")


GSPLAT = RasterSpec()
# Except that footprints there are squares of three sigma in whole tiles. Here they
# extend to alpha_threshold.
INRIA = RasterSpec(near=0.2, far=float("inf"), clamp_gradient="through")
