"""The page of `experiments.evidence` in docs/results."""

from experiments import markdown
from nerfies_jax.preprocessing.against_truth import LATER

SCENES = f"""\
## The built-in scenes

Sixty frames of 176x132 of each scene, with images and cameras only. *Mask* is the
intersection over union of the moving mask and the true one, and *false* the share of
all pixels that are wrongly marked as moving. *Track* is the median error of moving
ground-truth points {LATER} frames after their start, and *lost* the share of points
that are visible then but no longer tracked. *Place* is the error of 3D paths as a share
of the typical distance, *said* is their estimated deviation, and *groups* the number of
rigid motions that explain them to one part in a hundred."""
FLOWS = """\
## Optical flow methods

The same pairs of neighboring frames of the built-in scenes, normalized to one mean and
deviation, at their size and enlarged first. Errors are medians over pixels that both
frames show, and the share of these with an error above one pixel. Processor seconds are
for one pair and one direction."""


def page(stored) -> str:
    """Format the tables from the results of `--scenes`.

    Args:
      stored: The stored results.

    Returns:
      Markdown.
    """
    heads = (
        *("scene", "mask", "false %", "track px", "lost %", "place %", "said %"),
        *("tracks", "paths", "groups", "static points", "CPU s"),
    )
    scenes = [
        [
            row["scene"],
            markdown.number(row["mask_iou"], 3),
            _percent(row["false_share"], 2),
            markdown.number(row["track_px"]),
            _percent(row["track_lost"], 0),
            _percent(row["path_error"], 2),
            _percent(row["path_deviation"], 1),
            f"{row['tracks']:,}",
            f"{row['paths']:,}",
            str(row["groups"]),
            f"{row['points']:,}",
            markdown.number(row["seconds"], 1),
        ]
        for row in stored["scenes"]
    ]
    flows = [
        [
            row["method"],
            str(row["enlarged"]),
            markdown.number(row["still_px"], 3),
            markdown.number(row["moving_px"], 3),
            _percent(row["far_off"], 1),
            markdown.number(row["seconds"], 3),
        ]
        for row in stored["flows"]
    ]
    kinds = ("method", "enlarged", "static px", "moving px", "off %", "CPU s")
    return "\n\n".join(
        [SCENES, markdown.table(heads, scenes), FLOWS, markdown.table(kinds, flows)]
    )


def _percent(share, digits):
    return "" if share is None else markdown.number(100 * share, digits)
