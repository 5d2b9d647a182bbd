"""What is off costs nothing: no parameters, no state, no operations, no other bits.

A preset from which everything was removed is the static scene of `tests.bare_scenes`,
which knows of no effect: the compiled steps have the same flops, bytes and memory and
give the same bits. A preset from which effects were removed (and what cannot be
without them) is the scene that was put together by hand from the others, while every
function of the modules of the missing ones refuses to be called: both lower to the same
text, and a compiler that gets the same text makes the same program.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gaussians_jax.motion import (
    anchor_motion,
    carried,
    skinning,
    temporal_opacity,
    time_basis,
)
from gaussians_jax.motion import codes as motion_codes
from gaussians_jax.motion import nodes as node_motion
from gaussians_jax.per_frame.exposure import ExposureSpec
from gaussians_jax.per_frame.poses import PoseRefinementSpec
from gaussians_jax.scene import presets as splat_presets
from gaussians_jax.scene import scene as splat_scene
from gaussians_jax.scene import view_order
from nerfies_jax import evaluation
from nerfies_jax.fields import spec as field_spec
from nerfies_jax.metrics import clock
from nerfies_jax.nn import entropy, planes
from nerfies_jax.scene import presets as field_presets
from nerfies_jax.scene import scene as field_scene
from nerfies_jax.scene import steps as field_steps
from tests import bare_scenes, hand_made_effects, scenes
from tests.bare_scenes import parts_of, without
from tests.hand_made_effects import FIELD_MODULES

# How many layers of a tiny preset read what these add to the template: one in each of
# two networks, and there again behind the skip.
WIDENED = {"appearance": 2, "ambient": 4}


class Started:
    """A scene on the tiny capture: its model, first state and frames."""

    def __init__(self, spec, build, metadata_of):
        self.capture = scenes.tiny_capture()
        self.spec, self.metadata = spec, metadata_of(self.capture)
        self.model = build(spec, self.metadata)
        self.frames = evaluation.frames_of(self.capture, self.model.required_data)

    def init(self, key):
        return self.model.init(self.capture, key)

    @functools.cached_property
    def state(self):
        if isinstance(self.spec, field_spec.RadianceScene):
            return jax.jit(self.init)(jax.random.key(0))
        return self.init(jax.random.key(0))  # draws on the host

    def lower(self):
        """The step as the compiler gets it."""
        if isinstance(self.spec, field_spec.RadianceScene):
            state = jax.eval_shape(self.init, jax.random.key(0))
        else:
            state = self.state
        return jax.jit(self.model.step).lower(state, self.frames)


def started_field(spec):
    return Started(
        spec, field_scene.build, lambda capture: field_scene.metadata_of(capture, spec)
    )


def started_splats(spec):
    return Started(spec, splat_scene.build, splat_scene.metadata_of)


def bare(spec):
    alone = without(spec, *parts_of(spec))
    if not isinstance(alone, field_scene.RadianceScene):
        return alone
    any_ray = dataclasses.replace(alone.sampling, occupancy=None)
    return dataclasses.replace(alone, sampling=any_ray)


def same_bits(result, expected):
    result, expected = (
        jax.tree_util.tree_flatten_with_path(x)[0] for x in (result, expected)
    )
    assert [path for path, _ in result] == [path for path, _ in expected]
    for (path, one), (_, other) in zip(result, expected, strict=True):
        if jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other, err_msg=jax.tree_util.keystr(path))


def same_program(ours, by_hand, *args):
    """Equal cost as compiled, and bitwise equal results."""
    ours, by_hand = jax.jit(ours), jax.jit(by_hand)
    cost, expected = clock.cost(ours, *args), clock.cost(by_hand, *args)
    assert cost._replace(compile_seconds=0) == expected._replace(compile_seconds=0)
    assert cost.flops > 0
    same_bits(ours(*args), by_hand(*args))


# Every kind of static field: two networks for two levels, one for both, one level, a
# coarse network of its own that does not see the direction, a fine level that sees its
# own samples alone, and samples around the captured volume.
@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    [
        "nerf-small",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("nerf", "d-nerf", "nsff")),
        pytest.param("nerf-grid-small", marks=pytest.mark.slow),
        pytest.param("nerf-w-grid-small", marks=pytest.mark.slow),
    ],
)
def test_a_field_without_effects_is_the_static_one_bit_for_bit(name):
    run = started_field(bare(bare_scenes.tiny_field(name)))
    step = bare_scenes.field_step(run.spec, run.metadata, field_steps.draw_batch)
    same_program(run.model.step, step, run.state, run.frames)


def test_there_is_no_other_kind_of_static_field():
    def kind(name):
        spec = field_presets.PRESETS[name]
        plan, coarse = spec.sampling, spec.coarse
        two = plan.fine > 0
        blind = two and coarse is not None and coarse.direction is None
        union = plan.union or not two
        ways = plan.shared, union, plan.spacing, plan.jitter, spec.density_noise
        return two, blind, *ways

    few = "nerf-small", "nerf", "d-nerf", "nsff", "nerf-grid-small", "nerf-w-grid-small"
    held = {kind(name) for name in few}
    # SMALL_D_NERF has two networks, and NSFF's levels are one
    assert {kind(name) for name in field_presets.PRESETS} == held


@pytest.mark.full
@pytest.mark.parametrize(
    "name", ["splats-static-small", pytest.param("sonata", marks=pytest.mark.slow)]
)
def test_splats_without_effects_are_the_static_ones_bit_for_bit(name):
    run = started_splats(bare(bare_scenes.tiny_splats(name)))
    step = bare_scenes.splat_step(run.spec, run.metadata, view_order.shuffled_row)
    same_program(run.model.step, step, run.state, run.frames)


def check_removed(run, start, owner, make):
    """Nothing is left of what was removed, as if it had never been there."""
    gone = hand_made_effects.absent_modules(run.spec)
    assert gone
    lowered = run.lower().as_text()
    with pytest.MonkeyPatch.context() as patch, hand_made_effects.poisoned(gone):
        patch.setattr(owner, "effects_of", make)
        upwards = start(run.spec)
        assert upwards.lower().as_text() == lowered
        if start is started_splats:  # a field draws its first state in a program
            same_bits(run.state, upwards.state)


# Others need these, or do nothing without them: each is removed by itself.
BASES = ("appearance", "warp", "scene_flow", "motion")


def removals(presets):
    """Each part once, with the others of the first paper's preset that has it.

    Each removal traces two programs, and what is left of one of several effects shows
    as well as what is left of one alone. Small presets are those papers' in kind.
    """
    of = {}
    for name, spec in presets.items():
        for part in parts_of(spec) if not name.endswith("-small") else ():
            of.setdefault(part, name)
    groups = {}
    for part, name in of.items():
        groups.setdefault((name, part if part in BASES else ""), []).append(part)
    return [
        pytest.param(name, parts, id=f"{name}-{'-'.join(parts)}")
        for (name, _), parts in groups.items()
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "parts"), removals(field_presets.PRESETS))
def test_a_field_without_effects_is_one_that_never_had_them(preset, parts):
    run = started_field(without(bare_scenes.tiny_field(preset), *parts))
    check_removed(run, started_field, field_spec, hand_made_effects.of_field)


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "parts"), removals(splat_presets.PRESETS))
def test_splats_without_effects_are_some_that_never_had_them(preset, parts):
    run = started_splats(without(bare_scenes.tiny_splats(preset), *parts))
    check_removed(run, started_splats, splat_scene, hand_made_effects.of_splats)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["exposure", "poses"])
def test_splats_without_what_no_preset_has_are_some_that_never_had_it(part):
    both = {"exposure": ExposureSpec(), "poses": PoseRefinementSpec()}
    spec = dataclasses.replace(bare_scenes.tiny_splats("splats-static"), **both)
    run = started_splats(without(spec, part))
    check_removed(run, started_splats, splat_scene, hand_made_effects.of_splats)


class Inner(NamedTuple):
    """A part of an effect: where it is, and what is its alone."""

    preset: str
    owner: str
    off: dict  # the owner's settings without it
    module: object
    functions: tuple[str, ...]
    places: tuple[str, ...] = ()  # of its arrays
    narrower: tuple[str, ...] = ()  # what it makes wider


def of_motion(preset, *rest):
    return Inner(preset, "motion", *rest)


INNER = {
    "rate": of_motion(
        "adc-gs", {"rate": None}, entropy, ("noisy", "quantize", "bits"), (".law",)
    ),
    "moves": of_motion(
        "adc-gs",
        {"moves": False},
        anchor_motion,
        ("offsets",),
        (".times", ".coarse", ".fine"),
        (".residual", ".context.heads"),
    ),
    "turns": Inner(
        "d-miso",
        "carried",
        {"turns": None},
        carried,
        ("turns", "network_spec"),
        (".nets['carried']",),
    ),
    "mask": of_motion(
        "edgs", {"mask": None}, node_motion, ("openness",), (".mask", ".moving")
    ),
    "rigidity": of_motion(
        "sc-gs", {"rigidity": None}, skinning, ("links", "arap_error"), (".links",)
    ),
    "coarser": of_motion(
        "sonata",
        {"coarser": None},
        motion_codes,
        ("read", "fine_rows", "growth_steps"),
        ("['kan_motion'].rows", "['kan_motion'].coarse"),
    ),
    "fading": of_motion(
        "spacetime", {"fading": None}, temporal_opacity, ("faded",), (".fading",)
    ),
    "sparsity": of_motion("dynmf", {"sparsity": None}, time_basis, ("sparsity",)),
    # A weight of zero leaves its term out; each by itself in the tests of the motions.
    "penalties of codes": of_motion(
        "e-d3dgs",
        {"smoothness": 0.0, "opacity": 0.0},
        motion_codes,
        ("second_differences", "mean_opacity"),
    ),
    "penalties of planes": of_motion(
        "4dgs",
        {"variation": 0.0, "bend": 0.0, "unrest": 0.0},
        planes,
        ("total_variation", "time_smoothness", "l1_time_planes"),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("part", INNER)
def test_a_part_of_an_effect_that_is_off_is_not_asked_and_has_no_arrays(part):
    one = INNER[part]
    whole = whole_splats(one.preset)
    start = by_path(whole.state)
    off = dataclasses.replace(getattr(whole.spec, one.owner), **one.off)
    run = started_splats(dataclasses.replace(whole.spec, **{one.owner: off}))
    with pytest.MonkeyPatch.context() as patch:
        hand_made_effects.refuse(patch, one.module, one.functions)
        own = by_path(run.state)
        jax.eval_shape(run.model.step, run.state, run.frames)
        with pytest.raises(AssertionError, match="is off and was called"):
            jax.eval_shape(whole.model.step, whole.state, whole.frames)
    rest = {path: leaf for path, leaf in start.items() if not at(path, one.places)}
    assert (len(rest) < len(start)) == bool(one.places)
    assert own.keys() == rest.keys()
    for path in [path for path in rest if at(path, one.narrower)]:
        few, more = own.pop(path), rest.pop(path)
        assert few.size < more.size or ".count" in path, path  # one for each row
    same_bits(own, rest)


@functools.cache
def whole_splats(preset):
    return started_splats(bare_scenes.tiny_splats(preset))


def by_path(tree):
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


def at(path, places):
    return any(place in path for place in places)


def test_small_presets_have_parts_that_papers_have():
    # Penalties from elsewhere. Their values and gradients are checked in
    # test_regularizers.py and test_ray_distortion.py.
    ours = {"opacity_scale", "distortion"}
    for presets in (field_presets.PRESETS, splat_presets.PRESETS):
        for name, spec in presets.items():
            paper = presets[name.removesuffix("-small").removesuffix("-grid")]
            assert set(parts_of(spec)) - ours <= set(parts_of(paper)), name


@pytest.mark.full
@pytest.mark.parametrize(
    "preset", ["nerf-w", pytest.param("hypernerf", marks=pytest.mark.slow)]
)
def test_what_an_effect_does_shows_in_the_places_of_the_operations(preset):
    """Without which the tests above could not fail."""
    run = started_field(bare_scenes.tiny_field(preset))
    jax.clear_caches()
    places = run.lower().as_text(debug_info=True)
    for part in parts_of(run.spec):
        shown = hand_made_effects.file_of(FIELD_MODULES[part]) in places
        # An appearance code is looked up elsewhere: its module has no operation
        assert shown == (part != "appearance"), part


def test_a_poisoned_effect_cannot_be_built():
    refused = pytest.raises(AssertionError, match="is off and was called")
    with hand_made_effects.poisoned([FIELD_MODULES["warp"]]), refused:
        field_spec.effects_of(bare_scenes.tiny_field("d-nerf"), None)


@pytest.mark.full
@pytest.mark.parametrize(
    ("preset", "part"),
    [
        ("nerf-w", "appearance"),
        pytest.param("hypernerf", "ambient", marks=pytest.mark.slow),
    ],
)
def test_what_stays_starts_from_the_numbers_it_had(preset, part):
    spec = bare_scenes.tiny_field(preset)
    whole, rest = (
        dict(jax.tree_util.tree_flatten_with_path(started_field(s).state.params)[0])
        for s in (spec, without(spec, part))
    )
    same = {path for path in rest if rest[path].shape == whole[path].shape}
    assert len(rest) - len(same) == WIDENED.get(part, 0)
    for path in same:
        np.testing.assert_array_equal(rest[path], whole[path], err_msg=str(path))


@pytest.mark.full
@pytest.mark.parametrize(
    ("start", "spec"),
    [
        (started_field, bare(bare_scenes.tiny_field("nerfies"))),
        (started_splats, bare(bare_scenes.tiny_splats("moba"))),
    ],
    ids=["field", "splats"],
)
def test_an_image_without_effects_asks_none(start, spec):
    run = start(spec)
    view = evaluation.view_of(run.capture, 0)
    modules = hand_made_effects.absent_modules(spec)
    every = {
        True: hand_made_effects.FIELD_MODULES
        | {"time_warp": hand_made_effects.time_warp},
        False: hand_made_effects.SPLAT_MODULES
        | hand_made_effects.MOTION_MODULES
        | {"sky": hand_made_effects.sky},
    }
    assert modules == [*every[start is started_field].values()]

    def draw(params):
        return run.model.render(params, view, (8, 6), jnp.int32(0))

    with hand_made_effects.poisoned(modules):
        places = jax.jit(draw).lower(run.state.params).as_text(debug_info=True)
    for module in modules:
        assert hand_made_effects.file_of(module) not in places
