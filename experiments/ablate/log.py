"""Messages of a running ablation."""

from experiments.ablate.measures import MEASURES
from nerfies_jax.runtime import console


def log(text: str) -> None:
    """To the user, beside the results."""
    console.note(text)


def line(numbers: dict[str, float]) -> str:
    """A finished arm in a few numbers."""
    names = ("psnr", "moving_psnr", "depth_median", "track_error", "train_seconds")
    parts = (
        f"{name} {numbers[name]:.{MEASURES[name].digits}f}"
        for name in names
        if numbers[name] == numbers[name]
    )
    return ", ".join(parts)
