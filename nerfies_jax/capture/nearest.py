"""Suggestions for errors that refuse an unknown name."""

import difflib
from collections.abc import Iterable


def known_names(name: str, known: Iterable[str]) -> str:
    """List the known names, and the most similar one if there is any.

    Similar names have a ratio of 0.6 or more, the default of `difflib`.

    Args:
      name: The unknown name.
      known: The known names.

    Returns:
      Text such as "did you mean X? there are X, Y, Z".
    """
    known = list(known)
    listed = f"there are {', '.join(known)}" if known else "there are none"
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}? {listed}" if near else listed
