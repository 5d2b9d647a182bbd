"""Floors in words: how little a run did, and what to do about it."""

from collections.abc import Mapping

LONGER = "train longer (--seconds, --steps) or take another preset"


def lines(found: Mapping[str, float]) -> list[str]:
    """Both floors and what motion is worth, for the end of a run."""
    parts = []
    if "floor.neighbours" in found:
        parts.append(f"{found['floor.neighbours']:.2f} dB the mean of two neighbours")
    if "floor.still" in found:
        parts.append(f"{found['floor.still']:.2f} dB its own renders averaged in time")
    said = [f"floors:   {', '.join(parts)}"] if parts else []
    if "motion.worth" in found:
        where = ""
        if "motion.moving_worth" in found:
            where = f", {_signed(found['motion.moving_worth'])} where something moves"
        said.append(f"motion:   is worth {_signed(found['motion.worth'])}{where}")
    return said


def warnings(found: Mapping[str, float]) -> list[str]:
    """One line for each floor that the run is below."""
    psnr, said = found["heldout.psnr"], []
    if psnr < found.get("floor.neighbours", psnr):
        said.append(
            f"warning: {psnr:.2f} dB is below the {found['floor.neighbours']:.2f} dB "
            f"of two neighbouring frames laid over each other: {LONGER} "
            "(python -m experiments.inspect_scene says which)"
        )
    if found.get("motion.worth", 0.0) < 0:
        said.append(
            f"warning: held-out frames are {-found['motion.worth']:.2f} dB worse than "
            f"the mean of the scene's own renders over time: its motion is wrong; "
            f"{LONGER}, one that stands still (splats-static, nerf) if nothing moves"
        )
    return said


def _signed(decibels):
    """With two digits, and no sign of minus before nothing."""
    return f"{round(decibels, 2) + 0.0:+.2f} dB"
