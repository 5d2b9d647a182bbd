"""Text about the baselines of a run, with advice if it is below them."""

from collections.abc import Mapping

LONGER = "train longer (--seconds, --steps) or take another preset"

# A motion may cost so little and not be wrong: one came to -0.0017 dB.
_WORSE_DB = -0.05


def lines(numbers: Mapping[str, float]) -> list[str]:
    """Describe the baselines and the gain from motion, for the end of a run.

    Args:
      numbers: Metrics by key.

    Returns:
      Lines of text.
    """
    parts = []
    if "floor.neighbors" in numbers:
        parts.append(f"{numbers['floor.neighbors']:.2f} dB the mean of two neighbors")
    if "floor.still" in numbers:
        parts.append(
            f"{numbers['floor.still']:.2f} dB its own renders averaged in time"
        )
    text = [f"floors:   {', '.join(parts)}"] if parts else []
    if "motion.worth" in numbers:
        where = ""
        if "motion.moving_worth" in numbers:
            where = f", {_signed(numbers['motion.moving_worth'])} where something moves"
        text.append(f"motion:   is worth {_signed(numbers['motion.worth'])}{where}")
    return text


def warnings(numbers: Mapping[str, float]) -> list[str]:
    """Warn of each baseline that the run is below.

    Args:
      numbers: Metrics by key.

    Returns:
      One line for each.
    """
    psnr, sentences = numbers["heldout.psnr"], []
    if psnr < numbers.get("floor.neighbors", psnr):
        sentences.append(
            f"warning: {psnr:.2f} dB is below the {numbers['floor.neighbors']:.2f} dB "
            f"of two neighboring frames laid over each other: {LONGER} "
            "(python -m experiments.inspect_scene says which)"
        )
    if numbers.get("motion.worth", 0.0) < _WORSE_DB:
        sentences.append(
            f"warning: held-out frames are {-numbers['motion.worth']:.2f} dB worse "
            "than the mean of the scene's own renders over time: its motion is wrong; "
            f"{LONGER}, one that stands still (splats-static, nerf) if nothing moves"
        )
    return sentences


def _signed(decibels):
    """With two digits, and no sign of minus before nothing."""
    return f"{round(decibels, 2) + 0.0:+.2f} dB"
