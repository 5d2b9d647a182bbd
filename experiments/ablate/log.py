"""What an ablation tells its user while it runs."""

import sys

from experiments.ablate.measures import MEASURES


def log(text: str) -> None:
    """To the user, beside the results."""
    print(text, file=sys.stderr, flush=True)


def line(numbers: dict[str, float]) -> str:
    """A finished arm in a few numbers."""
    names = ("psnr", "moving_psnr", "depth_median", "track_error", "train_seconds")
    parts = (
        f"{name} {numbers[name]:.{MEASURES[name].digits}f}"
        for name in names
        if numbers[name] == numbers[name]
    )
    return ", ".join(parts)
