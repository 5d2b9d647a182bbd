"""Network modules as pure functions with explicit parameters."""

import lazy_loader

# Modules of the public API, imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["adapters", "kan"])
