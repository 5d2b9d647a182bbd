"""The page of `experiments.evidence` in docs/results."""

from experiments import markdown
from nerfies_jax.evidence.against_truth import LATER

SCENES = f"""\
## The built-in scenes

Sixty frames of 176x132 of each, nothing but pictures and cameras. *Mask* is the
intersection of the moving mask with the true one over their union, *false* the share of
all pixels that are marked and stand still. *Track* is how far points of the truth that
move are from where they should be {LATER} frames after they began (median), *lost* the
share of those still to be seen then that are not followed any more. *Place* is how far
their paths in space are off, as a share of the typical distance, beside *said*, the
deviation that the paths give of themselves; *groups* the rigid motions that explain
them to one part in a hundred."""
FLOWS = """\
## Ways to find flow

The same pairs of neighboring frames of the built-in scenes, pictures brought to one
mean and spread, as they are and enlarged first; medians where both frames show the
point, and the share of these pixels that are more than a pixel off. Seconds of the
processor are for one pair, one way."""


def page(stored) -> str:
    """Everything below the docstring, from what `--scenes` wrote."""
    heads = ("scene", "mask", "false %", "track px", "lost %", "place %", "said %")
    heads += ("tracks", "paths", "groups", "points at rest", "CPU s")
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
    kinds = ("way", "enlarged", "at rest px", "moving px", "off %", "CPU s")
    return "\n\n".join(
        [SCENES, markdown.table(heads, scenes), FLOWS, markdown.table(kinds, flows)]
    )


def _percent(share, digits):
    return "" if share is None else markdown.number(100 * share, digits)
