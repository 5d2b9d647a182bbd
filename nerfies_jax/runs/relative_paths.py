"""Relative paths for reports, which must not reveal folders of the machine."""

import os
import pathlib
import re

# The separator must follow a space or punctuation, so that "dB/s" does not match.
_ABSOLUTE = re.compile(r"""(?<![^\s"'(=,])(?:[A-Za-z]:)?[/\\](?:[^\s"'(),:;]+)""")


def base_of(folder: str | os.PathLike) -> pathlib.Path:
    """Choose the base of relative paths: the current folder if it contains `folder`.

    Args:
      folder: The folder of a run.

    Returns:
      The absolute path of the current folder, or of `folder` itself.
    """
    folder, current = pathlib.Path(folder).absolute(), pathlib.Path.cwd()
    return current if folder.is_relative_to(current) else folder


def relative(path: str | os.PathLike, base: pathlib.Path) -> str:
    """Write a path relative to a folder.

    Args:
      path: The path, absolute or relative to the current folder.
      base: The absolute path of the folder.

    Returns:
      The relative path with forward slashes. If the path is on another drive, only its
      file name.
    """
    path = pathlib.Path(path).absolute()
    try:
        return pathlib.Path(os.path.relpath(path, base)).as_posix()
    except ValueError:  # another drive on Windows
        return path.name


def in_text(text: str, folder: str | os.PathLike) -> str:
    """Replace the absolute paths in a sentence by relative ones.

    Args:
      text: The sentence.
      folder: The folder of a run.

    Returns:
      The sentence. Paths in the run folder and in the current folder are relative to
      `base_of(folder)`, and other paths are reduced to their file names.
    """
    base = base_of(folder)
    absolute = pathlib.Path(folder).absolute()
    for root in (absolute, absolute.resolve(), pathlib.Path.cwd()):
        if root != pathlib.Path(root.anchor):
            pattern = rf"{re.escape(str(root))}(?![\w-])"
            text = relative(root, base).join(re.split(pattern, text))
    return _ABSOLUTE.sub(lambda match: pathlib.PurePath(match[0]).name, text)
