"""What is said of a record, and what it is held against where the truth is known."""

import dataclasses

import numpy as np
import pytest

from nerfies_jax.preprocessing import (
    against_truth,
    contact_sheet,
    record,
    summary,
    view_set,
)
from nerfies_jax.preprocessing.against_truth import TruePoints
from tests.preprocessing import two_planes
from tests.preprocessing.test_tracks import MOVES, card_path, gathered


def views_of(capture):
    return view_set.in_time_order(capture)


def card_points(capture, rows):
    """The truth of a few points of the card, visible wherever they are in the image."""
    views = views_of(capture)
    inner = np.linspace(-0.6, 0.6, 4) * two_planes.CARD
    offset = np.stack(np.meshgrid(inner, inner), -1).reshape(-1, 1, 2)
    flat = card_path(capture, rows)[None] + offset
    place = np.concatenate([flat, np.full((*flat.shape[:2], 1), two_planes.NEAR)], -1)
    pixel, visible = [], []
    for frame in range(len(rows)):
        at, depth = view_set.project(views, frame, place[:, frame])
        pixel.append(at)
        visible.append(view_set.in_image(views, at, depth))
    return TruePoints(np.stack(pixel, 1), np.stack(visible, 1), place)


def test_errors_are_those_of_what_was_followed(monkeypatch):
    monkeypatch.setattr(against_truth, "LATER", 8)
    capture, evidence = gathered()
    points = card_points(capture, evidence.row)
    errors = against_truth.errors(capture, evidence, points)
    assert errors.mask_iou > 0.7
    assert errors.track_px < 0.5
    assert errors.track_lost < 0.5
    assert errors.path_error < 0.05
    # What is said to be two pixels and a tenth of the distance away is that far off.
    shifted = points.pixel + np.linspace(0, 3, len(evidence.row))[:, None] * [0, 1]
    moved = points.position * 1.1
    wrong = against_truth.errors(
        capture, evidence, TruePoints(shifted, points.visible, moved)
    )
    assert wrong.track_px == pytest.approx(8 * 3 / (len(evidence.row) - 1), abs=0.5)
    assert wrong.path_error == pytest.approx(0.065, abs=0.03)
    half = dataclasses.replace(capture, moving=np.zeros_like(capture.moving))
    bare = against_truth.errors(half, evidence, points)
    assert np.isnan(bare.mask_iou)
    assert bare.false_share == evidence.moving.mean()


@pytest.mark.full
def test_words_say_what_there_is_and_what_cannot_be_told():
    capture, evidence = gathered()
    counted = summary.of(views_of(capture), evidence)
    text = "\n".join(summary.lines(counted, evidence))
    assert counted.groups == 1
    assert "their depth is accurate" in text
    assert "motion is unknown" not in text
    held = two_planes.make(
        card=MOVES["card"], camera=lambda t: (0.0, 0.0, 0.0), frames=24
    )
    evidence = record.gather(held)
    counted = summary.of(views_of(held), evidence)
    text = "\n".join(summary.lines(counted, evidence))
    assert "is unknown, because the camera has no parallax" in text
    assert counted.paths > 20
    assert "their depth cannot be estimated" in text
    none = evidence._replace(
        path_tracks=evidence.path_tracks.take(slice(0)),
        paths=type(evidence.paths)(*(p[:0] for p in evidence.paths)),
    )
    text = summary.lines(summary.of(views_of(held), none), none)
    assert text[-1].startswith("motion is unknown: no track")


def test_the_sheet_shows_what_moves_and_its_tracks():
    capture, evidence = gathered()
    views = views_of(capture)
    bare = evidence._replace(
        moving=np.zeros_like(evidence.moving),
        tracks=evidence.tracks.take(slice(0)),
        path_tracks=evidence.path_tracks.take(slice(0)),
        score=np.zeros(0),
    )
    full, empty = (
        contact_sheet.followed(views, one).astype(int) for one in (evidence, bare)
    )
    assert full.shape == empty.shape
    yellow = (np.array(contact_sheet.BY_ITSELF) == full).all(-1)
    assert yellow.sum() > 500
    assert not (np.array(contact_sheet.BY_ITSELF) == empty).all(-1).any()
