"""The result of one check of a capture."""

from typing import NamedTuple


class Finding(NamedTuple):
    """Value that a check measured, and the problem that it shows, if any."""

    subject: str  # property that was checked, in a few words
    value: str  # measured value
    problem: str = ""  # the problem, its likely cause and the remedy; empty if none
    refused: bool = False  # True if the capture cannot be reconstructed
