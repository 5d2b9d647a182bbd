"""Runs and their folders, for any installed representation.

Modules are imported on first use: the settings of a command (`runs.config`) must not
cost an import of JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
