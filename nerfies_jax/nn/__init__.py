"""Small differentiable functions with explicit parameters."""

import lazy_loader

# Modules that `nerfies_jax` shows; each is loaded when it is used.
__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["adapters", "kan"])
