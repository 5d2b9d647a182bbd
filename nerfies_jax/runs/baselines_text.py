"""Text about the baselines of a run, with a warning if it scores below them."""

from collections.abc import Mapping

from nerfies_jax.metrics.metric_table import main_key

# A static model loses a little to rounding: -0.0017 dB was measured.
WORSE_DB = -0.05
MOSTLY_TRACKED = 0.5  # share of moving pixels near tracks. Built-in scenes have more.


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
            f"{numbers['baseline.neighbor_mean']:.2f} dB for the mean of the two "
            "neighboring frames"
        )
    if "baseline.static" in numbers:
        parts.append(
            f"{numbers['baseline.static']:.2f} dB for static renders (averaged over "
            "time)"
        )
    text = [f"baselines:  {', '.join(parts)}"] if parts else []
    if "motion.gain" in numbers:
        region = ""
        if "motion.moving_gain" in numbers:
            region = f", {_with_sign(numbers['motion.moving_gain'])} in dynamic regions"
        text.append(
            f"motion:     {_with_sign(numbers['motion.gain'])} compared with static "
            f"renders{region}"
        )
    return text


def warnings(
    numbers: Mapping[str, float], tracked_share: float | None = None
) -> list[str]:
    """Warn of each baseline that the run scores below.

    Args:
      numbers: Metrics by key.
      tracked_share: Share of the moving pixels near a track that the motion was
        initialized from. None without such an initialization.

    Returns:
      One line for each of these baselines.
    """
    psnr, sentences = numbers[main_key("heldout.psnr", numbers)], []
    if psnr < numbers.get("baseline.neighbor_mean", psnr):
        sentences.append(
            f"warning: {psnr:.2f} dB is below the "
            f"{numbers['baseline.neighbor_mean']:.2f} dB of the mean of two "
            "neighboring frames; train for more steps, or use the preset that "
            "nerfies inspect_scene recommends"
        )
    if numbers.get("motion.gain", 0.0) < WORSE_DB:
        sentences.append(
            f"warning: held-out frames score {-numbers['motion.gain']:.2f} dB less "
            "than renders of the model averaged over time, so its motion is wrong"
            f"{_cause(tracked_share)}; more steps do not correct it. A static preset "
            "(splats-static, nerf) is more accurate, and external tracks and masks of "
            "what moves, or smaller steps between frames, make motion possible"
        )
    return sentences


def _cause(tracked_share):
    """Name what the motion lacked, as the continuation of a sentence."""
    if tracked_share is None:
        return ": it was not initialized from tracks"
    if tracked_share < MOSTLY_TRACKED:
        return (
            f": tracks were found near only {tracked_share:.0%} of the moving pixels, "
            "so most of what moves was not followed"
        )
    return f", although tracks were found near {tracked_share:.0%} of the moving pixels"


def _with_sign(decibels):
    """Format with a sign and two decimals. Zero is never negative."""
    return f"{round(decibels, 2) + 0.0:+.2f} dB"
