"""Radiance fields of moving scenes, and the ground both representations share.

Floors 1-5 (`geometry`, `nets`, `capture`, `training`, and `measure`, `evaluation`,
`evidence`) hold what every reconstruction needs: cameras, small networks, captures, the
training loop, metrics, a renderer. `gaussians_jax` reads those floors and nothing above
them. A room reads only rooms on lower floors.

The names of `__init__.pyi` are the face of the package; each is loaded when it is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
