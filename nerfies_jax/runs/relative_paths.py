"""Paths as shown in a report, none of which begins at the root of the machine."""

import os
import pathlib
import re

# A path of two parts at least: a single one, as in "dB/s", is none of a machine.
_ABSOLUTE = re.compile(r"""(?<![^\s"'(=,])(?:[A-Za-z]:)?[/\\](?:[^\s"'(),:;]+)""")


def base_of(folder: str | os.PathLike) -> pathlib.Path:
    """Choose the base of relative paths: the current folder if `folder` is in it.

    Args:
      folder: The folder of a run.

    Returns:
      The absolute path of the current folder, or of `folder` itself.
    """
    folder, here = pathlib.Path(folder).absolute(), pathlib.Path.cwd()
    return here if folder.is_relative_to(here) else folder


def relative(path: str | os.PathLike, base: pathlib.Path) -> str:
    """Write a path relative to a folder.

    Args:
      path: The path. If it is not absolute, it is relative to the current folder.
      base: The absolute path of the folder.

    Returns:
      The relative path with forward slashes, or the last part of the path if it is on
      another drive.
    """
    path = pathlib.Path(path).absolute()
    try:
        return pathlib.Path(os.path.relpath(path, base)).as_posix()
    except ValueError:  # another drive of Windows
        return path.name


def in_text(text: str, folder: str | os.PathLike) -> str:
    """Rewrite the absolute paths in a sentence.

    Args:
      text: The sentence.
      folder: The folder of a run.

    Returns:
      The sentence with paths in the run folder and in the current folder relative to
      the base, and with the last part alone of every other path.
    """
    base = base_of(folder)
    here = pathlib.Path(folder).absolute()
    for root in (here, here.resolve(), pathlib.Path.cwd()):
        if root != pathlib.Path(root.anchor):
            known = rf"{re.escape(str(root))}(?![\w-])"
            text = relative(root, base).join(re.split(known, text))
    return _ABSOLUTE.sub(lambda match: pathlib.PurePath(match[0]).name, text)
