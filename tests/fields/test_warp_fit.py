"""Warps of fields fitted to known paths."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerfies_jax.fields.effects import scene_flow
from nerfies_jax.fields.effects.appearance import AppearanceSpec
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.scene import presets, scene, warp_fit
from nerfies_jax.scene import steps as field_steps
from nerfies_jax.scene.warp_fit import PointPaths
from nerfies_jax.training.effects import FrameCondition
from nerfies_jax.training.model import View
from nerfies_jax.training.track_start import FieldStartSpec

FRAMES = 16
TRACKS = FieldStartSpec("tracks", fit_steps=300, fit_rate=2e-3)


@pytest.fixture(autouse=True)
def few_points_a_step(monkeypatch):
    """One body and a wall ask for no more; a third of the time."""
    monkeypatch.setattr(warp_fit, "FRAMES_AT_ONCE", 8)
    monkeypatch.setattr(warp_fit, "STILL_AT_ONCE", 32)


def turning_body(points=40):
    """[points, FRAMES, 3] places of a body that turns by a radian and shifts."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, FRAMES, dtype=np.float32)
    turn = Rotation.from_rotvec(time[:, None] * [0, 0.6, 0.8]).as_matrix()
    body = rng.normal(0, 0.15, (points, 3))
    path = np.einsum("tij,nj->nti", turn, body) + time[:, None] * [0.4, 0, 0]
    return path.astype(np.float32), time


def some_paths(known=None, static=200):
    path, time = turning_body()
    if known is None:
        known = np.random.default_rng(1).uniform(size=path.shape[:2]) < 0.6
    wall = np.random.default_rng(2).uniform(-1, 1, (static, 3)).astype(np.float32)
    wall[:, 2] = 1
    return PointPaths(time, np.zeros(FRAMES, int), path, known, wall)


def narrow(network):
    """A third as wide as a small preset's: one body is soon learned."""
    return dataclasses.replace(network, depth=3, width=32)


def field_of(name):
    spec = dataclasses.replace(presets.PRESETS[name], start=TRACKS)
    if spec.warp is not None:
        spec = dataclasses.replace(spec, warp=narrow(spec.warp))
    if spec.scene_flow is not None:
        medium = narrow(spec.scene_flow.network)
        medium = dataclasses.replace(spec.scene_flow, network=medium)
        spec = dataclasses.replace(spec, scene_flow=medium)
    metadata = scene.SceneMetadata(
        0.1, 2.0, (0.0, 0.0, 0.0), 1.0, None,
        tuple(np.linspace(0, 1, FRAMES).tolist()), ((0, 0, 0.0),),
    )  # fmt: skip
    return scene.field(spec, metadata)


def canonical_places(field, params):
    """Function of a time and of points then, compiled once for as many points."""

    def one(point, view):
        codes = field.codes_at(params, view)
        condition = FrameCondition(view.time, codes, jnp.int32(field.spec.steps))
        return point + field.displace(params, point, condition)

    program = jax.jit(jax.vmap(one, (0, None)))

    def places(time, points):
        return np.asarray(program(points, View(None, np.float32(time), np.int32(0))))

    return places


def mean_spread(places, paths):
    """Mean distance of known positions in the template to the median of their point."""
    frames = zip(paths.time, paths.position.swapaxes(0, 1), strict=True)
    back = np.stack([places(time, points) for time, points in frames], axis=1)
    back[~paths.known] = np.nan
    off = back - np.nanmedian(back, axis=1, keepdims=True)
    return np.nanmean(np.linalg.norm(off, axis=-1))


@pytest.mark.full
@pytest.mark.parametrize("name", ["nerfies-small", "d-nerf-small"])
def test_a_fitted_warp_brings_a_body_to_one_place_and_moves_no_wall(name):
    field, paths = field_of(name), some_paths()
    params = field.init(jax.random.key(0))
    fitted = warp_fit.fit(field, params, paths, jax.random.key(0), TRACKS)
    places, canonical = canonical_places(field, fitted), []
    assert mean_spread(canonical_places(field, params), paths) > 0.1
    assert mean_spread(places, paths) < 0.03
    for frame in (3, 12):
        points = np.concatenate([paths.position[:, frame], paths.static])
        back, wall = np.split(places(paths.time[frame], points), [len(paths.position)])
        canonical.append(back)
        # It keeps its size: all of it in one point would be near to its place, too.
        size = np.linalg.norm(back - back.mean(0), axis=-1)
        body = paths.position[:, frame]
        true = np.linalg.norm(body - body.mean(0), axis=-1)
        assert 0.9 < np.median(size / true) < 1.1
        assert np.median(np.linalg.norm(wall - paths.static, axis=-1)) < 0.03
    # Also where a path was not known.
    off = np.linalg.norm(np.subtract(*canonical), axis=-1)
    assert np.median(off) < 0.04


@pytest.mark.hard_cases
def test_a_warp_into_one_point_has_finite_slopes(dtype):
    path, time = turning_body()
    rest = np.zeros((1, 3), dtype)
    ids = np.zeros(FRAMES, int)
    paths = PointPaths(time, ids, path.astype(dtype), path[..., 0] < 9, rest)
    field = types.SimpleNamespace(
        spec=types.SimpleNamespace(steps=1),
        codes_at=lambda *_: {},
        displace=lambda params, point, _: -params["share"] * point,
    )
    distances = warp_fit._distances(field, {}, paths)
    batch = jnp.arange(4), jnp.arange(40), jnp.asarray(rest), jax.random.key(0)

    @jax.jit
    def stretch(share):
        places = jnp.asarray(path[:, 0], dtype)
        return distances({"share": share}, places, *batch)[2]

    value, slope = jax.jit(jax.value_and_grad(stretch))(jnp.asarray(1.0, dtype))
    expected = warp_fit.STRETCH * (np.log(warp_fit.LEAST_STRETCH) / 2) ** 2
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert np.isfinite(slope)
    # What keeps its size costs nothing, half of it the square of its logarithm.
    assert stretch(jnp.asarray(0.0, dtype)) < 1e-6
    half = warp_fit.STRETCH * np.log(2) ** 2
    np.testing.assert_allclose(stretch(jnp.asarray(0.5, dtype)), half, rtol=1e-4)


@pytest.mark.parametrize(("start", "first"), [(TRACKS, 0.01), (FieldStartSpec(), 1.0)])
def test_what_tracks_have_found_learns_slowly_at_first(start, first):
    spec = dataclasses.replace(
        presets.PRESETS["nerfies-small"], start=start, appearance=AppearanceSpec()
    )
    effects = field_of("nerfies-small").effects
    codes = {"motion": None, "appearance": None}
    params = dict.fromkeys(("warp", "template")) | {"codes": codes}
    for step, share in ((0, first), (spec.steps // 2, first**0.5), (spec.steps, 1)):
        rates = field_steps.learning_rates(spec, effects, params, jnp.int32(step))
        of_codes = rates["codes"]
        if start is TRACKS:
            np.testing.assert_allclose(of_codes["appearance"], rates["template"])
            of_codes = of_codes["motion"]
        for own in (rates["warp"], of_codes):
            np.testing.assert_allclose(own / rates["template"], share, rtol=1e-5)


@pytest.mark.full
def test_a_motion_of_one_s_own_may_have_no_parameters():
    field = field_of("nerfies-small")
    own = FieldRecord("own", displace=lambda params, point, condition: 0 * point)
    field = field._replace(effects=(*field.effects, own))
    params = field.init(jax.random.key(0))
    assert "own" not in params
    rates = field_steps.learning_rates(field.spec, field.effects, params, jnp.int32(0))
    assert rates.keys() == params.keys()
    start = dataclasses.replace(TRACKS, fit_steps=2)
    fitted = warp_fit.fit(field, params, some_paths(), jax.random.key(0), start)
    assert fitted.keys() == params.keys()


def test_a_flow_with_a_trunk_of_its_own_learns_slowly_at_first_and_its_medium_not():
    small = presets.PRESETS["nsff-small"]
    flow = dataclasses.replace(small.scene_flow, flow_trunk=True)
    spec = dataclasses.replace(small, start=TRACKS, scene_flow=flow)
    field = scene.field(spec, field_of("nsff-small").metadata)
    params = field.init(jax.random.key(0))
    rates = field_steps.learning_rates(spec, field.effects, params, jnp.int32(0))
    (own, common) = rates["scene_flow"], rates["template"]
    for slow in (own.flow, own.flow_trunk):
        np.testing.assert_allclose(slow / common, spec.start.first_rate, rtol=1e-5)
    assert own.network == own.disocclusion == own.blend == common


def test_a_flow_that_was_not_fitted_is_not_held_back():
    """Beside a warp, which is fitted to the tracks alone."""
    preset = presets.PRESETS["nsff-grid-small"]
    warp = presets.PRESETS["nerfies-small"].warp
    spec = dataclasses.replace(preset, start=TRACKS, warp=warp)
    field = scene.field(spec, field_of("nsff-small").metadata)
    params = jax.eval_shape(field.init, jax.random.key(0))
    rates = field_steps.learning_rates(spec, field.effects, params, jnp.int32(0))
    own, common = rates["scene_flow"], rates["scene_flow"].blend
    assert own.flow == own.flow_trunk == common
    np.testing.assert_allclose(rates["warp"] / common, spec.start.first_rate, rtol=1e-5)


@pytest.mark.parametrize("motion", ["tracks", "none"])
def test_a_medium_on_tables_learns_at_the_rate_of_the_template(motion):
    preset = presets.PRESETS["nsff-grid-small"]
    spec = dataclasses.replace(preset, start=FieldStartSpec(motion=motion))
    field = scene.field(spec, field_of("nsff-small").metadata)
    params = jax.eval_shape(field.init, jax.random.key(0))
    rates = field_steps.learning_rates(spec, field.effects, params, jnp.int32(0))
    own = rates["scene_flow"]
    assert own.network == rates["template"] == spec.template_rate * own.blend


def test_codes_learn_at_a_rate_of_their_own():
    preset = presets.PRESETS["nerf-w-grid-small"]
    field = scene.field(preset, field_of("nsff-small").metadata)
    params = jax.eval_shape(field.init, jax.random.key(0))
    rates = field_steps.learning_rates(preset, field.effects, params, jnp.int32(0))
    assert set(params["codes"]) == {"appearance", "transient"}
    expected = preset.code_rate * preset.learning_rate
    np.testing.assert_allclose(rates["codes"], expected, rtol=1e-6)


@pytest.mark.full
def test_a_fitted_flow_leads_from_one_place_to_the_next_and_from_no_wall():
    """Against the body's own velocity; also where frames are two times apart.

    Or none: two cameras saw the tenth.
    """
    field, paths = field_of("nsff-small"), some_paths()
    frames = np.array([*range(0, 8), 9, *range(9, FRAMES)])
    paths = paths._replace(
        time=paths.time[frames],
        appearance=paths.appearance[frames],
        position=paths.position[:, frames],
        known=paths.known[:, frames],
    )
    params = field.init(jax.random.key(0))
    fitted = warp_fit.fit_flow(field, params, paths, jax.random.key(0), TRACKS)
    path, time = turning_body()

    def flow(medium, point, time):
        spec, toward = field.spec.scene_flow, jnp.zeros(3)
        return scene_flow.dynamic(spec, medium, point, toward, time).flow

    program = jax.jit(jax.vmap(flow, (None, 0, None)))

    def error(params):
        """Of the flow from and to every pair of frames that follow each other."""
        ahead, back = np.moveaxis(
            [program(params["scene_flow"], path[:, f], time[f]) for f in range(FRAMES)],
            -2,
            0,
        )
        true = np.diff(path.swapaxes(0, 1), axis=0)
        off = np.stack([ahead[:-1] - true, back[1:] + true])
        return np.linalg.norm(off, axis=-1).mean()

    assert error(fitted) < 0.3 * error(params)
    ask = functools.partial(program, fitted["scene_flow"])
    for frame in (3, 8, 12):  # the ninth was never observed
        ahead, back = np.moveaxis(np.asarray(ask(path[:, frame], time[frame])), 1, 0)
        true = path[:, frame + 1] - path[:, frame]
        size = np.linalg.norm(true, axis=-1).mean()
        assert np.linalg.norm(ahead - true, axis=-1).mean() < 0.3 * size
        true = path[:, frame - 1] - path[:, frame]
        assert np.linalg.norm(back - true, axis=-1).mean() < 0.3 * size
        wall = np.asarray(ask(paths.static, time[frame]))
        assert np.linalg.norm(wall, axis=-1).mean() < 0.1 * size


@pytest.mark.full
def test_points_seen_once_leave_everything_where_it_is():
    """Each has one place: there is no motion to find, and no wall that holds it."""
    known = np.zeros((40, FRAMES), bool)
    known[np.arange(40), np.arange(40) % FRAMES] = True
    field, paths = field_of("nerfies-small"), some_paths(known, static=0)
    params = field.init(jax.random.key(0))
    fitted = warp_fit.fit(field, params, paths, jax.random.key(0), TRACKS)
    places = paths.position[known]
    moved = canonical_places(field, fitted)(0.5, places)
    assert np.abs(moved - places).max() < 0.03
    off = [
        canonical_places(field, fitted)(paths.time[frame], places[row : row + 1])
        for row, frame in enumerate(np.arange(40) % FRAMES)
    ]
    assert np.linalg.norm(np.concatenate(off) - places, axis=-1).mean() < 5e-3


def test_what_cannot_be_fitted_is_refused_by_name():
    field = field_of("nerfies-small")
    params = field.init(jax.random.key(0))
    with pytest.raises(ValueError, match="no path is known"):
        warp_fit.fit(
            field,
            params,
            some_paths(np.zeros((40, FRAMES), bool)),
            jax.random.key(0),
            TRACKS,
        )
    alone = np.zeros((40, FRAMES), bool)
    alone[:, 4] = True
    with pytest.raises(ValueError, match="in two frames that follow each other"):
        warp_fit.fit_flow(
            field_of("nsff-small"), params, some_paths(alone), jax.random.key(0), TRACKS
        )
    with pytest.raises(ValueError, match=r'start\.motion="tracks" fits a warp'):
        dataclasses.replace(presets.PRESETS["nerf-small"], start=TRACKS)
    with pytest.raises(ValueError, match=r"start\.first_rate=0.0 must be a fraction"):
        FieldStartSpec(first_rate=0.0)
