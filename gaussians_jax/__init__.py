"""Dynamic scenes as 3D Gaussians, in pure JAX.

It imports the packages of `nerfies_jax` that both representations share (`geometry`,
`nn`, `capture`, `training`, `metrics`, `preprocessing`, `evaluation`), and no others.

The public names are listed in `__init__.pyi`, and each is imported when it is used.
"""

import lazy_loader

from nerfies_jax.runtime import earlier_names
from nerfies_jax.runtime.version import __version__ as __version__

earlier_names.install()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
