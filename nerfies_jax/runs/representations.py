"""Installed representations, discovered through their entry points."""

import functools
import importlib.metadata
import json
import pathlib
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:  # not at run time, so that importing this module imports no JAX
    from collections.abc import Callable

    from nerfies_jax.capture.capture import Capture
    from nerfies_jax.evaluation.representation import Choice, Representation

from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runs.platform import Threads
from nerfies_jax.runs.run_folder import CONFIG
from nerfies_jax.training import extensions, specs

GROUP = "nerfies_jax.representations"
# Preset of a run without a preset whose capture has usable tracks of moving points.
USUAL = "splats-tracked-small"
# Presets of both packages, because command lines are parsed without importing JAX.
PRESETS = (
    *("splats-collection", "splats-collection-small"),
    *("splats-static", "splats-mcmc", "splats-tracked", "splats-deformable"),
    *("sonata", "moba", "dynmf", "spacetime", "spline", "4dgs", "sc-gs", "edgs"),
    *("e-d3dgs", "e-d3dgs-small"),
    *("dynmf-small", "spacetime-small", "spline-small", "4dgs-small"),
    *("sc-gs-small", "edgs-small", "d-miso", "d-miso-small"),
    *("adc-gs", "adc-gs-small", "motion-gs", "motion-gs-small"),
    *("nerf", "nerf-w", "d-nerf", "t-nerf", "nerfies", "hypernerf"),
    *("tineuvox", "tineuvox-small", "nerf-ds", "nerf-ds-small"),
    *("nsff", "splats-static-small", "splats-mcmc-small", "splats-tracked-small"),
    *("splats-deformable-small", "sonata-small", "moba-small", "nerf-small"),
    *("nerf-w-small", "d-nerf-small", "t-nerf-small", "nerfies-small"),
    *("hypernerf-small", "nsff-small", "nerf-grid-small", "nerf-w-grid-small"),
    *("d-nerf-grid-small", "nerfies-grid-small", "hypernerf-grid-small"),
    "nsff-grid-small",
)


@functools.cache
def installed() -> dict[str, "Representation"]:
    """Load all installed representations.

    Returns:
      Representations by name, in the order of their names.

    Raises:
      ValueError: If there are none.
    """
    points = importlib.metadata.entry_points(group=GROUP)
    # A checkout that is both installed and on the path has two entry points.
    by_name = {point.name: point for point in points}
    if not by_name:
        raise ValueError(
            f"no entry points in the group {GROUP}: install this package, for example "
            "with pip install -e ."
        )
    return {name: by_name[name].load() for name in sorted(by_name)}


def named(name: str) -> "Representation":
    """Return a representation by its name.

    Args:
      name: The name.

    Returns:
      The representation.

    Raises:
      ValueError: If there is none with that name.
    """
    if name not in installed():
        names = known_names(name, installed())
        raise ValueError(f"no representation {name!r}; {names}")
    return installed()[name]


def choosing() -> (
    "list[tuple[Representation, Callable[[Capture, float | int | None], Choice]]]"
):
    """Return the representations that choose presets, with their functions."""
    pairs = []
    for each in installed().values():
        recommendation = each.recommendation
        if recommendation is not None and recommendation.default_preset is not None:
            pairs.append((each, recommendation.default_preset))
    return pairs


def of_preset(preset: str) -> "Representation":
    """Return the representation that a preset belongs to.

    Args:
      preset: Name of the preset.

    Returns:
      The representation.

    Raises:
      ValueError: If there is no such preset.
    """
    for representation in installed().values():
        if preset in representation.presets:
            return representation
    presets = sorted(p for each in installed().values() for p in each.presets)
    raise ValueError(f"no preset {preset!r}; {known_names(preset, presets)}")


def of_run(folder: pathlib.Path) -> "Representation | None":
    """Return the representation of a run.

    Args:
      folder: The run folder.

    Returns:
      The representation, or None if it cannot be read. `run.read_settings` reports the
      reason.
    """
    try:
        content = json.loads((folder / CONFIG).read_text())
        return named(content["representation"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def stored_spec(
    representation: "Representation", stored: Any, *, load: bool = False
) -> Any:
    """Parse the spec that is stored in a run folder.

    Args:
      representation: The representation of the run.
      stored: JSON values.
      load: True to import classes of other packages that it names, which runs their
        code.

    Returns:
      The spec.

    Raises:
      ValueError, TypeError: If it is not a spec of that representation.
    """
    spec_type = representation.spec_type
    names = extensions.names_in(stored, specs.TYPE) if load else ()
    others = [name for name in names if name not in specs.allowed_names(spec_type)]
    return specs.from_json(stored, spec_type, *map(extensions.load_class, others))


class Cores(NamedTuple):
    """Arguments of `platform.start_jax` for a scene."""

    threads: Threads
    shares: int


def cores(preset: str | None, overrides: tuple[str, ...] = ()) -> Cores:
    """Return the number of cores for training a preset.

    Args:
      preset: Name of the preset. None for the default preset.
      overrides: Overrides of its fields, as PATH=VALUE.

    Returns:
      The arguments of `platform.start_jax`.

    Raises:
      ValueError: If the preset or a field does not exist.
    """
    if preset is None:
        preset, overrides = USUAL, ()
    representation = of_preset(preset)
    spec = specs.override(representation.presets[preset], overrides)
    resources = representation.resources
    return Cores(resources.threads, resources.shares(spec))


def cores_of_run(folder: pathlib.Path) -> Cores:
    """Return the number of cores for the run in a folder.

    Args:
      folder: The run folder.

    Returns:
      The arguments of `platform.start_jax`, or the defaults if the run cannot be read.
    """
    representation = of_run(folder)
    if representation is None:
        return Cores("all", 1)
    try:
        spec = json.loads((folder / CONFIG).read_text())["spec"]
        shares = representation.resources.shares(stored_spec(representation, spec))
    except (OSError, ValueError, KeyError, TypeError):
        shares = 1
    return Cores(representation.resources.threads, shares)
