"""Masks for a capture without: the evidence's, on the frames learned from alone."""

import dataclasses
import types

import numpy as np
import pytest

from nerfies_jax.preprocessing import frame_masks
from tests import scenes


def evidence_of(capture, factor, unusable=""):
    """Evidence of a capture, at images so many times smaller: its first pixel moves
    in every frame, the others as they are drawn.
    """
    height, width = (side // factor for side in capture.images.shape[1:3])
    moving = np.random.default_rng(0).uniform(size=(len(capture.train), height, width))
    moving = moving < 0.3
    moving[:, 0, 0] = True
    return types.SimpleNamespace(
        row=capture.train, moving=moving, factor=factor, unusable=unusable
    )


@pytest.mark.parametrize("factor", [1, 5])
def test_masks_are_the_evidence_s_at_the_size_of_the_images(factor, monkeypatch):
    bare = dataclasses.replace(scenes.tiny_capture(), moving=None)
    evidence = evidence_of(bare, factor)
    monkeypatch.setattr(frame_masks.record, "cached", lambda *_: evidence)
    capture = frame_masks.with_masks(bare)
    height, width = bare.images.shape[1:3]
    for frame, row in enumerate(bare.train):
        for line, column in np.ndindex(height, width):
            small = tuple(
                min(place // factor, side - 1)
                for place, side in zip(
                    (line, column), evidence.moving.shape[1:], strict=True
                )
            )
            expected = evidence.moving[(frame, *small)]
            assert capture.moving[row, line, column] == expected
    assert not capture.moving[bare.heldout].any()
    assert "masks of moving objects were computed from" in capture.notes[-1]


def test_a_video_that_cannot_be_tracked_stays_without_masks(monkeypatch):
    bare = dataclasses.replace(scenes.tiny_capture(), moving=None)
    evidence = evidence_of(bare, 1, "one image is no video")
    monkeypatch.setattr(frame_masks.record, "cached", lambda *_: evidence)
    capture = frame_masks.with_masks(bare)
    assert capture.moving is None
    assert "one image is no video" in capture.notes[-1]
