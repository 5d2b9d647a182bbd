"""Text about the baselines of a run, with advice if it is below them."""

from collections.abc import Mapping

LONGER = "train for more steps or use another preset"

# Rounding alone can cost a static model a little: -0.0017 dB was measured.
_WORSE_DB = -0.05


def lines(numbers: Mapping[str, float]) -> list[str]:
    """Describe the baselines and the gain from motion, for the end of a run.

    Args:
      numbers: Metrics by key.

    Returns:
      Lines of text.
    """
    parts = []
    if "baseline.neighbor_mean" in numbers:
        parts.append(
            f"{numbers['baseline.neighbor_mean']:.2f} dB mean of two neighbors"
        )
    if "baseline.static" in numbers:
        parts.append(
            f"{numbers['baseline.static']:.2f} dB static (renders averaged over time)"
        )
    text = [f"baselines: {', '.join(parts)}"] if parts else []
    if "motion.gain" in numbers:
        where = ""
        if "motion.moving_gain" in numbers:
            where = f", {_signed(numbers['motion.moving_gain'])} in dynamic regions"
        text.append(f"motion:    gains {_signed(numbers['motion.gain'])}{where}")
    return text


def warnings(numbers: Mapping[str, float]) -> list[str]:
    """Warn of each baseline that the run is below.

    Args:
      numbers: Metrics by key.

    Returns:
      One line for each.
    """
    psnr, sentences = numbers["heldout.psnr"], []
    if psnr < numbers.get("baseline.neighbor_mean", psnr):
        sentences.append(
            f"warning: {psnr:.2f} dB is below the "
            f"{numbers['baseline.neighbor_mean']:.2f} dB of the mean of two "
            f"neighboring frames: {LONGER} "
            "(python -m experiments.inspect_scene says which)"
        )
    if numbers.get("motion.gain", 0.0) < _WORSE_DB:
        sentences.append(
            f"warning: held-out frames are {-numbers['motion.gain']:.2f} dB worse "
            "than the model's own renders averaged over time, so its motion is wrong: "
            f"{LONGER}, a static one (splats-static, nerf) if nothing moves"
        )
    return sentences


def _signed(decibels):
    """Format with two decimals, without a minus sign before zero."""
    return f"{round(decibels, 2) + 0.0:+.2f} dB"
