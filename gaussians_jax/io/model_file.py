"""A trained scene in one file: active Gaussians, networks and settings.

The file is a NumPy archive (.npz): one float32 array for each leaf of the parameters,
and one JSON text with the version of the format, the structure of the leaves and a
description. The description may hold the settings of a scene of this package, so that
the file is enough to render a frame:
    params, about = model_file.load("model.npz")
    model = scene.build(about["spec"], about["metadata"])
    step = jnp.asarray(about["step"], jnp.int32)
    rendering = model.render(params, view, (width, height), step)

with `gaussians_jax.scene.scene` and a `View` (nerfies_jax.training.model) of the camera
to render. Nothing in a file is executed (`nerfies_jax.training.specs`).
"""

import io
import json
import os
import pathlib
import zipfile
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gaussians_jax.core import splats
from gaussians_jax.core.splats import Params
from gaussians_jax.scene.spec import SceneMetadata, SplatScene
from nerfies_jax.capture import npz_files
from nerfies_jax.capture.errors import FileError
from nerfies_jax.capture.json_files import replaced_file
from nerfies_jax.training import extensions, specs

FORMAT = "gaussians_jax model"
VERSION = 2
ABOUT = "about.json"  # the archive's member with the text


def save(path: str | os.PathLike, params: Params, description: dict[str, Any]) -> int:
    """Write the active Gaussians and the networks in float32.

    The file is written completely or not at all.
    Args:
      path: File to write.
      params: Trained parameters.
      description: Plain values and frozen settings.

    Returns:
      Bytes of the file.

    Raises:
      ValueError: If a parameter is not finite.
    """
    path = pathlib.Path(path)
    rows = params.rows["splats"]
    active = splats.rows_to_write(rows, path)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[active], params.rows)
    arrays: dict[str, np.ndarray] = {}
    try:
        structure = _flatten(params._replace(rows=rows), "params", arrays)
        description_json = specs.as_json(description)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; not written") from error
    about = {
        "format": FORMAT,
        "version": VERSION,
        "params": structure,
        "description": description_json,
    }
    content = io.BytesIO()
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    members: dict[str, Any] = {ABOUT: text, **arrays}
    np.savez_compressed(content, **members)
    with replaced_file(path) as partial:
        partial.write_bytes(content.getvalue())
    return path.stat().st_size


def load(
    path: str | os.PathLike, trusted: Collection[str] = ()
) -> tuple[Params, dict[str, Any]]:
    """Read parameters and description.

    Args:
      path: The file.
      trusted: Names MODULE:NAME of classes from other packages that may be imported,
        which runs their code.

    Returns:
      The parameters and the description, in which sequences are tuples.

    Raises:
      FileError: If the file is damaged or not a model file, or names a class that is
        not trusted.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    try:
        with npz_files.archive(path) as archive:
            about = _about(archive)
            classes = _trusted_classes(about, trusted)
            params = _unflatten(about["params"], archive, classes)
        description = specs.from_json(
            about["description"], SplatScene, SceneMetadata, *classes.values()
        )
        _check(params)
    except FileError:  # it names the path already
        raise
    except _BROKEN as error:
        if isinstance(error.__cause__, zipfile.BadZipFile):
            raise FileError(
                f"{path}: not a model file, or damaged ({_line(error)}); save it again "
                "with model_file.save"
            ) from error
        raise FileError(f"{path}: {_line(error)}") from error
    return params, description


# Errors that reading a damaged file can raise.
_BROKEN = (*npz_files.DAMAGED, OSError, ArithmeticError)


def _line(error):
    return " ".join(str(error).split()) or type(error).__name__


def _about(archive):
    if ABOUT not in archive.names:
        raise ValueError(
            "the archive is not a model: it has no about.json; save models with "
            "model_file.save"
        )
    about = json.loads(archive.read(ABOUT).tobytes())
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise ValueError(f"its about.json does not describe a {FORMAT}")
    if about.get("version") != VERSION:
        raise ValueError(
            f"the model has version {about.get('version')}, but this version of the "
            f"library reads version {VERSION}; load it with the one that wrote it"
        )
    return about


def _check(params):
    """Check the structure, shapes and values that readers of parameters rely on."""
    if not isinstance(params, Params) or "splats" not in params.rows:
        raise ValueError("it holds no Gaussians: params.rows['splats'] is missing")
    count = len(params.rows["splats"].mean)
    for leaf in jax.tree.leaves(params.rows):
        if not leaf.ndim or len(leaf) != count:
            raise ValueError(
                f"per-Gaussian parameters of {count} Gaussians have an array of shape "
                f"{leaf.shape}"
            )
    for leaf in jax.tree.leaves(params):
        if not np.isfinite(leaf).all():
            raise ValueError("a value is not finite; save the model again")


# The structure of the parameters ----------------------------------------------------


def _flatten(tree, name, arrays):
    """Return the structure as JSON, and add its leaves to `arrays` by their path."""
    if tree is None:
        return None
    if isinstance(tree, dict):
        return {
            "dict": {
                key: _flatten(item, f"{name}.{key}", arrays)
                for key, item in tree.items()
            }
        }
    if isinstance(tree, tuple) and hasattr(tree, "_fields"):
        fields = {
            key: _flatten(item, f"{name}.{key}", arrays)
            for key, item in tree._asdict().items()
        }
        return {"record": specs.type_name(type(tree)), "fields": fields}
    if isinstance(tree, tuple | list):
        items = [_flatten(x, f"{name}.{i}", arrays) for i, x in enumerate(tree)]
        return {"tuple": items}
    leaf = np.asarray(tree)
    if leaf.dtype.kind == "f" or leaf.dtype == jnp.bfloat16:
        leaf = leaf.astype(np.float32)
    if leaf.dtype.kind not in "fiub":
        raise ValueError(f"{name} has type {leaf.dtype}, which is not a number")
    if not np.isfinite(leaf).all():
        raise ValueError(f"{name} has a value that is not finite")
    arrays[name] = leaf
    return {"array": name}


def _trusted_classes(about, trusted_names):
    """Import classes of other packages that the file names and the caller trusts."""
    names = (
        *extensions.names_in(about["params"], "record"),
        *extensions.names_in(about["description"], specs.TYPE),
    )
    for name in names:
        if name not in trusted_names:
            raise ValueError(
                f"it names {name!r} of another package, whose code would be executed; "
                f"load it with trusted=({name!r},) if you trust it"
            )
    return {name: extensions.load_class(name) for name in names}


def _unflatten(structure, archive, classes):
    if structure is None:
        return None
    if "array" in structure:
        return jnp.asarray(archive.read(structure["array"]))
    if "dict" in structure:
        items = structure["dict"].items()
        return {key: _unflatten(item, archive, classes) for key, item in items}
    if "tuple" in structure:
        items = structure["tuple"]
        return tuple(_unflatten(item, archive, classes) for item in items)
    name = structure["record"]
    record = classes[name] if name in classes else specs.record_named(name)
    fields = {
        key: _unflatten(item, archive, classes)
        for key, item in structure["fields"].items()
    }
    return specs.build_record(record, fields)
