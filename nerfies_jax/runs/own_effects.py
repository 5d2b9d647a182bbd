"""Effects from outside, named on a command line as MODULE:NAME."""

import importlib
from typing import Any

from nerfies_jax.training.effects import Effect


def load(names: tuple[str, ...], metadata: Any) -> tuple[Effect, ...]:
    """The effects of these names.

    NAME is an `Effect` of MODULE, or a function that returns one from what the scene
    knows of its capture (`SceneMetadata` of either package). MODULE is looked for where
    Python looks, the current folder among that. Raises ValueError where there is none.
    """
    return tuple(_load(name, metadata) for name in names)


def _load(name, metadata):
    module_name, colon, attribute = name.partition(":")
    if not (module_name and colon and attribute):
        raise ValueError(f"--effect {name}: expected MODULE:NAME, as my_effects:drift")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(
            f"--effect {name}: {module_name} cannot be imported ({error}); run where "
            "it lies, or name its folder in PYTHONPATH"
        ) from error
    named = getattr(module, attribute, None)
    if named is None:
        raise ValueError(f"--effect {name}: {module_name} has no {attribute!r}")
    # An effect is a tuple, which nobody can call.
    effect = named(metadata) if callable(named) else named
    if not isinstance(effect, Effect):
        raise ValueError(
            f"--effect {name}: a {type(effect).__name__}, and neither an Effect nor a "
            "function that returns one (docs/own_effect.md)"
        )
    return effect
