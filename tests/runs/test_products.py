"""What a run tells of its size and speed."""

import pytest

from nerfies_jax.evaluation.representation import Saved
from nerfies_jax.runs import products


@pytest.mark.parametrize(("preset", "notes"), [("moba-small", 1), ("splats-static", 0)])
def test_the_size_and_speed_stand_beside_the_papers(preset, notes):
    saved = Saved(2_345_678)
    lines = products.beside_the_paper(preset, saved, 40.0)
    assert len(lines) == notes
    for line in lines:
        for words in (
            "2.3 MB",
            "25 frames",
            "11.3 MB",
            "163 frames",
            "A100",
            "context",
        ):
            assert words in line
    assert not products.beside_the_paper(preset, Saved(), 40.0)
    (size,) = products.model_size(saved)
    assert (size.key, size.value) == ("file.bytes", 2_345_678)
