"""The options of a study, as its stored results record them."""

import pathlib
from typing import Any

from nerfies_jax.training import specs


def without_places(args: Any) -> dict[str, Any]:
    """Settings as JSON, without where on this machine things lie."""
    settings = specs.as_json(args) | {"out": None}
    if "captures" in settings:
        settings["captures"] = [pathlib.Path(path).name for path in args.captures]
    folder = settings.get("source", {}).get("capture")
    if folder is not None:
        settings["source"]["capture"] = pathlib.Path(folder).name
    return settings
