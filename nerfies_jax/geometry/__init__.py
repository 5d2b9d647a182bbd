"""Geometry of points, rotations, cameras and rays."""

import lazy_loader

# Modules of the public API, imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, ["matrix3", "quaternion", "se3", "so3"]
)
