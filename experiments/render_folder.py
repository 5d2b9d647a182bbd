"""The folder of one render: its name, and the record of what made it.

Renders of other settings have other names in RUN/renders. `render.json` in a folder
records the request, checkpoint and revision, so that a folder is only replaced without
--overwrite if the same images would be rendered again.
"""

import dataclasses
import hashlib
import json
import pathlib
from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

from experiments import cli

RECORD = "render.json"
# Settings that do not change what is rendered.
_NOT_RENDERED = ("run", "out", "overwrite", "device")


class Made(NamedTuple):
    """Settings that determine the images of a render, as JSON values."""

    request: dict[str, Any]  # settings by name
    run: dict[str, Any]  # the checkpoint: its step and checksum
    revision: str  # of this library


def name(args: Any) -> str:
    """Name the folder of a render in RUN/renders by the settings that are not default.

    Args:
      args: Settings of `nerfies render`.

    Returns:
      The name.
    """
    parts = [path_name(args.path)]
    if args.frames is not None:
        parts.append(f"frames-{args.frames}")
    if args.max_side is not None:
        parts.append(f"max-side-{args.max_side}")
    if args.freeze is not None:
        parts.append(f"at-{args.freeze:g}")
    if args.slow != 1:
        parts.append(f"slow-{args.slow:g}")
    parts += [f"without-{effect}" for effect in args.without]
    if args.appearance is not None:
        start, end = (frame.replace("/", "_") for frame in args.appearance)
        parts.append(f"from-{start}-to-{end}")
    if args.knots is not None:
        parts.append(f"knots-{args.knots}")
    if args.interpolation != "linear":
        parts.append(args.interpolation)
    if args.static_threshold is not None:
        parts.append(f"static-threshold-{args.static_threshold:g}")
    if args.hide_moving is not None:
        parts.append(f"hide-moving-{args.hide_moving:g}")
    if args.show != "color":
        parts.append(args.show)
    if {*args.formats} != {"png", "mp4"}:
        parts += sorted(args.formats)
    return "-".join(parts)


def path_name(path: str) -> str:
    """Name a camera path. That of a file includes a digest of what is in it.

    Args:
      path: A kind of path, or a file or folder of cameras.

    Returns:
      The name, for the name of a folder.
    """
    digest = _digest(path)
    stem = pathlib.PurePath(path).stem
    return stem if digest is None else f"{stem}-{digest[:8]}"


def _digest(path):
    """Return the SHA-256 of a file or folder, None if it does not exist."""
    place = pathlib.Path(path)
    if path in ("heldout", *cli.PATHS) or not place.exists():
        return None
    files = [place] if place.is_file() else sorted(place.glob("*.json"))
    digest = hashlib.sha256()
    for file in files:
        if place.is_dir():
            digest.update(file.name.encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def request(args: Any) -> dict[str, Any]:
    """Collect settings that determine the images, as JSON values, with digests of
    paths.

    Args:
      args: Settings of `nerfies render`.

    Returns:
      The values.
    """
    settings = dataclasses.asdict(args)
    for field in _NOT_RENDERED:
        del settings[field]
    settings["path"] = _digest(args.path) or args.path
    settings["formats"] = sorted(args.formats)
    return json.loads(json.dumps(settings))


def record(metadata: Made, args: Any, files: Iterable[str]) -> dict[str, Any]:
    """Assemble `render.json`.

    Args:
      metadata: Settings that determine the images.
      args: Settings of `nerfies render`.
      files: Files by their names in the folder.

    Returns:
      Content for JSON.
    """
    from nerfies_jax.training.provenance import provenance

    return {
        **metadata._asdict(),
        "path": args.path,
        "made by": provenance(),
        "files": [*files, RECORD],
    }


def replaceable(
    out: pathlib.Path, args: Any, metadata: Made, files: Collection[str]
) -> set[str]:
    """Find the files of an earlier render that this one may delete.

    Args:
      out: Folder of the render. It may be absent.
      args: Settings of `nerfies render`.
      metadata: Settings that determine the images of this render.
      files: Names of the files that this render will write.

    Returns:
      Names in the folder: of what its `render.json` lists, or, where it has none, of
      files that are named like those to be written.

    Raises:
      ValueError: The folder holds a render that would be lost, and overwriting it was
        not allowed.
    """
    from nerfies_jax.capture.json_files import alike, refuse_existing

    earlier = _earlier(out)
    if earlier is None:
        refuse_existing(out, args.overwrite)
        return alike(out, files)
    if not args.overwrite:
        _refuse_other(out, metadata, earlier)
    return {*earlier["files"]}


def refuse_early(out: pathlib.Path, args: Any) -> None:
    """Raise what `replaceable` would, where the settings alone show it."""
    from nerfies_jax.capture.json_files import refuse_existing

    earlier = _earlier(out)
    if earlier is None:
        refuse_existing(out, args.overwrite)
    elif not args.overwrite:
        record = Made(request(args), earlier["run"], earlier["revision"])
        _refuse_other(out, record, earlier)


def _earlier(out):
    """Read the record of a folder, None if there is no readable one."""
    try:
        earlier = json.loads((out / RECORD).read_text())
        valid = isinstance(earlier["request"], dict) and isinstance(
            earlier["run"], dict
        )
        has_names = all(isinstance(name, str) for name in earlier["files"])
        return earlier if valid and has_names and "revision" in earlier else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _refuse_other(out, metadata, earlier):
    """Raise where an earlier render is not the one that would replace it."""
    reason = _differs(metadata, earlier) or _first_edit(out, earlier)
    if reason:
        raise ValueError(
            f"{out}: holds another render ({reason}); name another folder with "
            "--out, or replace it with --overwrite"
        )


def _differs(metadata, earlier):
    """Describe the first difference from an earlier render, or return ''."""
    for place, now in (("request", metadata.request), ("run", metadata.run)):
        for key in dict.fromkeys((*now, *earlier[place])):
            before, after = earlier[place].get(key), now.get(key)
            if before != after:
                return f"{key} is {_words(before)} there and {_words(after)} here"
    if earlier["revision"] != metadata.revision:
        return (
            f"made by revision {earlier['revision']}, and this is {metadata.revision}"
        )
    return ""


def _words(value):
    return " ".join(value) if isinstance(value, list) else value


def _first_edit(out, earlier):
    """Name the first file that changed since it was rendered, or return an empty
    string.
    """
    # The record is written last, and a rename changes no time.
    record_time = (out / RECORD).stat().st_mtime_ns
    for file in earlier["files"]:
        path = out / file
        if path.is_file() and path.stat().st_mtime_ns > record_time:
            return f"{file} was changed after it was rendered"
    return ""
