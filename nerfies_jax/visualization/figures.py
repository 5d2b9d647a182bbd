"""Figures with axes, made by matplotlib (extra `report`)."""

import functools
from typing import Any

from nerfies_jax.capture import extras

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
