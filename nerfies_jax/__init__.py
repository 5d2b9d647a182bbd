"""Radiance fields of dynamic scenes, and the modules that both representations share.

`geometry`, `nets`, `capture`, `training`, `measure`, `evaluation` and `evidence` hold
what every reconstruction needs: cameras, small networks, captures, the training loop,
metrics, a renderer and preprocessing. `gaussians_jax` imports these modules only. A
module imports from lower layers only (docs/architecture.md).

The names in `__init__.pyi` are the public API. Each is imported when it is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
