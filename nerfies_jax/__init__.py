"""Radiance fields of dynamic scenes, and the modules that both representations share.

`geometry`, `nn`, `capture`, `training`, `metrics`, `preprocessing` and `evaluation`
hold what every reconstruction needs: cameras, small networks, captures, the training
loop, metrics, tracks and masks, and a renderer. `gaussians_jax` imports only these.
Modules import from lower layers only (docs/architecture.md).

The names in `__init__.pyi` are the public API. Each is imported when it is used.
"""

import lazy_loader

from nerfies_jax.runtime import earlier_names
from nerfies_jax.runtime.version import __version__ as __version__

earlier_names.install()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
