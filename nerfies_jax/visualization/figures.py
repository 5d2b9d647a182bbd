"""Figures with axes, made by matplotlib (extra `report`)."""

import functools
import hashlib
import json
import pathlib
from typing import Any

from nerfies_jax.capture import extras
from nerfies_jax.capture.json_files import replaced_file

DIGEST = "Digest"  # key of the digest of the plotted numbers in a PNG

library = functools.partial(extras.library, extra="report")


def new_figure(**options: Any) -> Any:
    """Create a `matplotlib.figure.Figure` that can be saved, without pyplot.

    pyplot would keep all figures in a global state.

    Args:
      **options: Arguments of the figure.

    Returns:
      The figure.

    Raises:
      MissingExtra: If matplotlib is not installed.
    """
    figure = library("matplotlib.figure").Figure(**options)
    library("matplotlib.backends.backend_agg").FigureCanvasAgg(figure)
    return figure


def digest(numbers: Any) -> str:
    """Return a digest of plotted numbers, by which a figure is compared with them.

    Args:
      numbers: The numbers, as JSON can store them.

    Returns:
      Hexadecimal digits of SHA-256.
    """
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()


def save(figure: Any, path: pathlib.Path, numbers: Any) -> None:
    """Save a figure on white, with the digest of its numbers under `DIGEST`.

    Args:
      figure: The figure.
      path: The PNG file, which is written completely or not at all.
      numbers: The plotted numbers.
    """
    with replaced_file(path) as partial:
        figure.savefig(partial, facecolor="white", metadata={DIGEST: digest(numbers)})
