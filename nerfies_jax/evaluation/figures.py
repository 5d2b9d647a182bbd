"""Figures with axes, drawn by matplotlib, which comes with the extra `report`."""

import functools
from typing import Any

from nerfies_jax.capture import extras

library = functools.partial(extras.library, extra="report")


def new_figure(**options: Any) -> Any:
    """A `matplotlib.figure.Figure` that can be saved, without pyplot.

    pyplot keeps every figure and a global state. Raises MissingExtra where matplotlib
    is not installed.
    """
    figure = library("matplotlib.figure").Figure(**options)
    library("matplotlib.backends.backend_agg").FigureCanvasAgg(figure)
    return figure
