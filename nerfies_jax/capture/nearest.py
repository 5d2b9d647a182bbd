"""Suggestions of similar names for error messages about unknown names."""

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
    listing = f"there are {', '.join(known)}" if known else "there are none"
    similar = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {similar[0]}? {listing}" if similar else listing
