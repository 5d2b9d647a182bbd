"""Moving scenes as 3D Gaussians, splatted in pure JAX.

Reads floors 1-5 of `nerfies_jax` (`geometry`, `nets`, `capture`, `training`, and
`measure`, `evaluation`, `evidence`) and nothing above them.

The names of `__init__.pyi` are the face of the package; each is loaded when it is used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
