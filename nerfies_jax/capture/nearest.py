"""What is known, with what was probably meant, for the errors that refuse a name."""

import difflib
from collections.abc import Iterable


def known_names(name: str, known: Iterable[str]) -> str:
    """`did you mean X? there are X, Y, Z`; without the question where nothing is near.

    Near is what shares 0.6 of the letters, the bound that `difflib` has for words.
    """
    known = list(known)
    listed = f"there are {', '.join(known)}" if known else "there are none"
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]}? {listed}" if near else listed
