"""Training: losses, schedules, the loop, checkpoints and small solvers."""

import lazy_loader

# Modules of the public API, imported on first use.
__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, ["losses"])
