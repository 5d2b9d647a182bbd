"""A second capture of the same shapes reuses the programs of the first."""

import dataclasses

import jax
import numpy as np
import pytest

from gaussians_jax import representation as splats
from gaussians_jax.losses.opacity_scale import OpacityScaleSpec
from gaussians_jax.losses.smooth_depth import SmoothDepthSpec
from gaussians_jax.per_frame.exposure import ExposureSpec
from nerfies_jax import evaluation, runs
from nerfies_jax import representation as fields
from nerfies_jax.capture import nerfies_format
from nerfies_jax.evaluation import renderer
from nerfies_jax.runs.config import CaptureSource, RunConfig
from nerfies_jax.training import chunk
from tests import compilations, scenes

MOST = 5  # compilations for a second capture
QUICK = ("strategy=none", "sh_degree=0", "init.extra_random=0")
SPLATS = dataclasses.replace(
    scenes.TINY_MOBA,
    exposure=ExposureSpec(),
    opacity_scale=OpacityScaleSpec(),
    smooth_depth=SmoothDepthSpec(),
)


def changed():
    """The tiny capture with other positions, times, bounds and background."""
    capture = scenes.tiny_capture()
    return dataclasses.replace(
        capture,
        near=1.1 * capture.near,
        far=1.1 * capture.far,
        points=capture.points._replace(position=1.1 * capture.points.position + 0.01),
        depths=1.1 * capture.depths,
        cameras=capture.cameras._replace(
            position=1.1 * capture.cameras.position + np.float32(0.01)
        ),
        background=(0.1, 0.2, 0.3),
        times=capture.times**1.1,
    )


def lowered(kind, spec, capture, monkeypatch):
    """The numbers of a model, and the texts of its step and of its render."""
    model = kind.build(spec, kind.metadata_of(capture, spec))
    state = model.example(capture, jax.random.key(0))
    frames = evaluation.frames_of(capture, model.required_data)
    step = chunk.Program(model, state, frames, 10)._lower(1)
    view = evaluation.view_of(capture, int(capture.heldout[0]))
    monkeypatch.setattr(renderer, "_compile_all", lambda _, *programs: programs)
    render = renderer.Renderer(model, capture.size).compiled(state, view)
    return model.numbers, [each.as_text() for each in jax.tree.leaves((step, render))]


@pytest.mark.parametrize(
    ("kind", "spec"),
    [(splats.GAUSSIANS, SPLATS), (fields.RADIANCE, scenes.TINY_FIELD)],
    ids=("splats", "field"),
)
def test_no_number_of_a_capture_is_compiled_into_a_program(kind, spec, monkeypatch):
    first, second = (
        lowered(kind, spec, capture, monkeypatch)
        for capture in (scenes.tiny_capture(), changed())
    )
    same = jax.tree.map(np.array_equal, first[0], second[0])
    # The exposures of this capture are not interpolated.
    assert [name for name in same if jax.tree.all(same[name])] == ["exposures"]
    assert first[1] == second[1]


@pytest.mark.full
def test_a_second_capture_compiles_next_to_nothing(tmp_path):
    counts = []
    with compilations.counted(tmp_path / "cache") as since:
        for index, capture in enumerate((scenes.tiny_capture(), changed())):
            folder = tmp_path / f"capture {index}"
            nerfies_format.write(capture, folder)
            source = CaptureSource(capture=folder)
            config = RunConfig("splats-static-small", source, 2, overrides=QUICK)
            since()
            assert not runs.reconstruct(config, tmp_path / f"run {index}").errors
            counts.append(since())
    assert counts[0] > 10  # the programs of the run are counted
    assert counts[1] <= MOST
