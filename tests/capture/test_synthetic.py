"""What a synthetic scene says of itself, against NumPy, SciPy and its own images."""

import dataclasses

import jax
import numpy as np
import pytest
import scipy.ndimage

from nerfies_jax.capture import nerfies_format, synthetic
from nerfies_jax.capture.synthetic import (
    photographed,
    presets,
    record,
    rendering,
    truth,
)
from nerfies_jax.capture.synthetic.collection import BASE_GAIN
from nerfies_jax.capture.synthetic.spec import Exposure, Specular, Transient
from nerfies_jax.geometry import camera as cameras
from tests import scene_oracle

SPEC = dataclasses.replace(
    presets.NON_RIGID,
    things=(presets.WALL, presets.FLOOR, presets.GLOBE, presets.CLOTH, presets.BALL),
    size=(48, 36),
    frames=7,
    heldout_every=2,
    points=300,
    tracks=60,
)
# Two boxes compile in a fraction of the time; the switches need a program each.
SMALL = dataclasses.replace(
    SPEC, things=(presets.WALL, presets.CUBE), points=50, tracks=9
)


@pytest.fixture(scope="module")
def scene():
    return synthetic.make(SPEC)


@pytest.fixture(scope="module")
def small():
    return synthetic.make(SMALL)


def pixels_of(capture, truth, rng, count, among=None):
    """Random (row, y, x), the world points seen there and the pixel centers."""
    shown = truth.things >= 0 if among is None else among
    places = rng.choice(np.flatnonzero(shown), count, replace=False)
    row, y, x = np.unravel_index(places, shown.shape)
    centers = np.stack([x, y], -1) + 0.5
    points = np.empty((count, 3))
    for i in range(count):
        camera = cameras.take(capture.cameras, row[i])
        along = scene_oracle.directions(camera, centers[i : i + 1])[0]
        points[i] = camera.position + capture.depths[row[i], y[i], x[i]] * along
    return (row, y, x), points, centers


def linear(images):
    coded = np.asarray(images, float) / 255
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def test_the_capture_has_the_frames_and_rows_that_were_asked_for(scene):
    capture, truth = scene
    assert capture.ids == truth.ids == tuple(sorted(capture.ids))
    assert capture.images.shape == (7 + 3, 36, 48, 3)
    assert capture.train.tolist() == list(range(7))
    assert capture.camera_ids.tolist() == [0] * 7 + [1] * 3
    assert capture.warp_ids.tolist() == [*range(7), 1, 3, 5]
    assert np.allclose(capture.times, capture.warp_ids / 6)
    assert (capture.near < capture.depths).all()
    assert (capture.far > capture.depths).all()
    assert (truth.things >= 0).all()  # the stage fills every image
    assert 0.05 < capture.moving.mean() < 0.4
    gap = capture.cameras.position[7:] - capture.cameras.position[[1, 3, 5]]
    assert np.allclose(np.linalg.norm(gap, axis=-1), np.hypot(0.09, 0.05), atol=1e-6)


def test_depth_and_ids_are_numpy_s(scene, rng):
    capture, truth = scene
    (row, y, x), _, centers = pixels_of(capture, truth, rng, 200)
    wrong = 0
    for i in range(len(row)):
        camera = cameras.take(capture.cameras, row[i])
        along = scene_oracle.directions(camera, centers[i : i + 1])[0]
        depth, thing = scene_oracle.first(
            SPEC.things,
            camera.position.astype(float),
            along,
            float(capture.times[row[i]]),
        )
        same = thing == truth.things[row[i], y[i], x[i]]
        wrong += not (same and abs(depth - capture.depths[row[i], y[i], x[i]]) < 2e-5)
    assert wrong <= 2  # pixel centers within rounding of a silhouette


def test_moving_pixels_are_those_whose_points_move(scene, rng):
    capture, truth = scene
    (row, y, x), points, _ = pixels_of(capture, truth, rng, 120)
    for i in range(len(row)):
        thing = SPEC.things[truth.things[row[i], y[i], x[i]]]
        at = float(capture.times[row[i]])
        canonical = scene_oracle.canonical(thing, points[i : i + 1], at)
        over_time = [
            scene_oracle.observe(thing, canonical, t) for t in (0, 0.2, 0.45, 0.8)
        ]
        travel = np.ptp(np.concatenate(over_time), axis=0).max()
        assert (travel > 1e-4) == capture.moving[row[i], y[i], x[i]]


@pytest.mark.parametrize("step", [1, -1])
def test_flow_leads_to_where_numpy_sees_the_moved_point(scene, rng, step):
    capture, truth = scene
    flow, seen = (
        (truth.flow_forward, truth.forward_valid)
        if step == 1
        else (truth.flow_backward, truth.backward_valid)
    )
    last = [6, 9] if step == 1 else [0, 7]
    assert not seen[last].any()
    assert not flow[last].any()
    has_next = np.ones(truth.things.shape, bool)
    has_next[last] = False
    wrong_sight = 0
    # Half of them where the point is lost, or the test would hardly look at occlusion.
    for among in (has_next & seen, has_next & ~seen):
        (row, y, x), points, centers = pixels_of(capture, truth, rng, 80, among)
        for i in range(len(row)):
            index = truth.things[row[i], y[i], x[i]]
            other = row[i] + step
            camera, time = (
                cameras.take(capture.cameras, other),
                float(capture.times[other]),
            )
            canonical = scene_oracle.canonical(
                SPEC.things[index], points[i : i + 1], float(capture.times[row[i]])
            )
            moved = scene_oracle.observe(SPEC.things[index], canonical, time)
            pixel = scene_oracle.project(camera, moved)[0]
            # float32 depth of a grazing ray is the largest part: 3e-4 px measured.
            assert np.abs(flow[row[i], y[i], x[i]] - (pixel - centers[i])).max() < 3e-3
            eye = camera.position.astype(float)
            distance, thing = scene_oracle.first(SPEC.things, eye, moved[0] - eye, time)
            inside = np.all((pixel >= 0) & (pixel <= SPEC.size))
            sees = inside and thing == index and abs(distance - 1) < 1e-3
            wrong_sight += sees != seen[row[i], y[i], x[i]]
    assert wrong_sight <= 2  # points within rounding of a border


def test_tracks_follow_numpy_s_map_and_meet_their_own_material(scene):
    capture, truth = scene
    moving = [i for i, thing in enumerate(SPEC.things) if thing.moves()]
    assert set(truth.track_thing) == set(moving)
    times = np.linspace(0, 1, SPEC.frames)
    for i, index in enumerate(truth.track_thing):
        canonical = truth.track_canonical[i : i + 1].astype(float)
        for instant, time in enumerate(times):
            exact = scene_oracle.observe(SPEC.things[index], canonical, time)
            assert np.abs(truth.track_world[i, instant] - exact).max() < 2e-6
    for row in range(len(capture.ids)):
        points = truth.track_world[:, capture.warp_ids[row]].astype(float)
        pixel = scene_oracle.project(cameras.take(capture.cameras, row), points)
        assert np.abs(truth.track_pixel[:, row] - pixel).max() < 1e-3
    assert 0.3 < truth.track_seen.mean() < 1
    row, seen = 4, np.flatnonzero(truth.track_seen[:, 4])
    x, y = truth.track_pixel[seen, row].astype(int).T
    assert np.mean(truth.things[row, y, x] == truth.track_thing[seen]) > 0.9


def test_static_points_have_the_same_color_for_both_cameras(scene, rng):
    capture, truth = scene
    differences, shuffled = [], []
    for row in (7, 8, 9):
        twin = int(np.flatnonzero(capture.warp_ids[:7] == capture.warp_ids[row])[0])
        among = np.zeros_like(truth.things, bool)
        among[row] = ~capture.moving[row]
        (_, y, x), points, _ = pixels_of(capture, truth, rng, 300, among)
        camera = cameras.take(capture.cameras, twin)
        pixel = scene_oracle.project(camera, points)
        column, line = np.floor(pixel).astype(int).T
        inside = (column >= 0) & (line >= 0) & (column < 48) & (line < 36)
        depth = (points - camera.position) @ camera.camera_from_world[2]
        seen = inside.copy()
        there = capture.depths[twin, line[inside], column[inside]]
        seen[inside] &= np.abs(there - depth[inside]) < 0.02
        here = capture.images[row, y, x][seen].astype(float)
        twin_color = capture.images[twin, line[seen], column[seen]].astype(float)
        differences.append(np.abs(here - twin_color))
        shuffled.append(np.abs(here - rng.permutation(twin_color)))
    # Half a pixel of misplacement remains, on a texture finer than these small pixels.
    same, other = np.concatenate(differences), np.concatenate(shuffled)
    assert len(same) > 300
    assert np.median(same) < 0.5 * np.median(other)


def test_points_lie_on_static_surfaces_with_little_noise(scene):
    capture, _ = scene
    assert len(capture.points.position) == SPEC.points
    static = [thing for thing in SPEC.things if not thing.moves()]
    eye = np.array([0.0, 0.1, 0.6])
    for point, color in zip(*capture.points, strict=True):
        # Signed distance to a box or ball: outside plus inside parts.
        gaps = []
        for thing in static:
            body = point - np.array(thing.place)
            if hasattr(thing.shape, "half"):
                outside = np.abs(body) - thing.shape.half
                gap = np.linalg.norm(np.maximum(outside, 0)) + min(outside.max(), 0)
            else:
                gap = np.linalg.norm(body) - thing.shape.radius
            gaps.append(abs(gap))
        assert min(gaps) < 5 * SPEC.point_noise
        assert np.linalg.norm(point - eye) < 2
        assert color.dtype == np.uint8


@pytest.mark.full
def test_supersampling_is_the_mean_light_of_a_finer_image(small):
    capture, _ = small
    fine = dataclasses.replace(SMALL, size=(96, 72), supersampling=1)
    plan = rendering.schedule(fine, 0)
    image = jax.jit(rendering.render, static_argnums=0)(
        fine, cameras.take(plan.cameras, 2), plan.time[2], plan.light_gain[2], False
    )
    light = linear(np.asarray(image.image) * 255)
    mean = light.reshape(36, 2, 48, 2, 3).mean((1, 3))
    # Eight-bit rounding, and one count where float32 rounds the other way.
    assert np.abs(linear(capture.images[2]) - mean).max() < 1.2 * 0.5 * 0.0090


def test_the_same_seed_repeats_and_another_moves_only_the_hand(small):
    capture, truth = small
    again, truth_again = synthetic.make(SMALL)
    for one, two in zip(truth, truth_again, strict=True):
        assert np.array_equal(one, two)
    assert np.array_equal(capture.images, again.images)
    assert np.array_equal(capture.points.position, again.points.position)
    other = rendering.schedule(SMALL, 1)
    assert np.array_equal(other.time, capture.times)
    shift = np.linalg.norm(other.cameras.position - capture.cameras.position, axis=-1)
    assert 0.001 < shift.mean() < 0.05


def test_exposure_changes_the_light_alone(small):
    capture, truth = small
    spec = dataclasses.replace(SMALL, exposure=Exposure(stops=0.4))
    lit, lit_truth = synthetic.make(spec)
    assert np.array_equal(lit.depths, capture.depths)
    assert np.array_equal(lit.moving, capture.moving)
    assert np.array_equal(lit.cameras.position, capture.cameras.position)
    assert np.array_equal(lit_truth.track_pixel, truth.track_pixel)
    assert (truth.light_gain == 1).all()
    gain = lit_truth.light_gain
    assert 0.2 < np.std(np.log2(gain[:, 1])) < 0.8
    assert np.array_equal(gain[7:], gain[[1, 3, 5]])  # an instant has one exposure
    before, after = linear(capture.images), linear(lit.images)
    expected = before * gain[:, None, None]
    # Brighter than rendered without it, single samples of a pixel may be clipped.
    clean = (gain[:, None, None] <= 1) & (expected > 0.05)
    assert clean.mean() > 0.2
    # 8 bits: half a count in either image is 2% of light 0.05.
    assert np.abs(after / np.maximum(expected, 1e-9) - 1)[clean].max() < 0.035


@pytest.mark.full
def test_a_transient_changes_its_own_pixels_alone(small):
    capture, _ = small
    passer = dataclasses.replace(presets.PASSER, place=(-0.3, 0.0, 0.2))
    spec = dataclasses.replace(SMALL, transient=Transient(passer, ((0.3, 0.7),)))
    passed, passed_truth = synthetic.make(spec)
    shown = passed_truth.transient.any((1, 2))
    assert shown.tolist() == [
        0.3 <= t <= 0.7 and c == 0
        for t, c in zip(capture.times, capture.camera_ids, strict=True)
    ]
    assert np.array_equal(passed.images[~shown], capture.images[~shown])
    assert np.array_equal(passed_truth.transient, passed_truth.things == 2)
    assert (passed.moving >= passed_truth.transient).all()
    changed = (passed.images != capture.images).any(-1)
    grown = passed_truth.transient.copy()
    grown[:, :, 1:] |= passed_truth.transient[:, :, :-1]
    grown[:, :, :-1] |= passed_truth.transient[:, :, 1:]
    assert not (changed & ~grown).any()  # a border pixel mixes both
    assert (changed & passed_truth.transient).sum() > 0.9 * passed_truth.transient.sum()
    assert not (passed_truth.track_thing == 2).any()
    # Where it will be gone in the next frame, its pixels are seen no more.
    leaves = shown[:-1] & ~shown[1:]
    gone = np.flatnonzero(leaves)[0]
    assert not passed_truth.forward_valid[gone][passed_truth.transient[gone]].any()


@pytest.mark.full
def test_a_specular_surface_adds_light_to_its_own_thing_alone(small):
    capture, truth = small
    spec = dataclasses.replace(SMALL, specular=Specular("cube", 0.8, 8.0))
    shiny, shiny_truth = synthetic.make(spec)
    assert np.array_equal(shiny_truth.things, truth.things)
    difference = shiny.images.astype(int) - capture.images
    assert difference.min() >= 0
    assert difference[truth.things == 1].max() > 20
    # A corner of the cube may reach into a pixel whose center, and four neighbors,
    # show the wall; then a diagonal neighbor shows the cube.
    inner = scipy.ndimage.binary_erosion(truth.things == 0, np.ones((1, 3, 3)))
    assert inner.any()
    assert difference[inner].max() == 0


@pytest.mark.full
def test_lumps_merge_and_part_and_a_shutter_opens_and_shuts():
    spec = dataclasses.replace(
        presets.TOPOLOGY, size=(88, 66), frames=9, heldout_every=8, supersampling=1
    )
    capture, truth = synthetic.make(spec)
    first = capture.camera_ids == 0

    def parts(*names):
        """Connected parts of these things in each image of the first camera."""
        shown = np.isin(truth.things[first], [spec.id_of(name) for name in names])
        return [scipy.ndimage.label(image)[1] for image in shown]

    # At eighths of the video: the lumps are one twice, the shutter at its middle and
    # both ends.
    assert parts("left lump", "right lump") == [2, 1, 2, 2, 2, 1, 2, 2, 2]
    assert parts("left shutter", "right shutter") == [1, 2, 2, 2, 1, 2, 2, 2, 1]
    # What one ball has inside the other is a surface before and after, not then.
    lumps = [spec.id_of(name) for name in ("left lump", "right lump")]
    radius = [spec.things[lump].shape.radius for lump in lumps]
    time = capture.times[first]
    vanished = 0
    for lump, other, reach in zip(lumps, lumps[::-1], radius[::-1], strict=True):
        center = np.stack(
            [scene_oracle.pose(spec.things[other], t)[:3, 3] for t in time]
        )
        mine = truth.track_thing == lump
        apart = np.linalg.norm(truth.track_world[mine] - center, axis=-1) - reach
        seen = truth.track_seen[mine][:, first]
        assert not seen[apart < -1e-3].any()
        vanished += ((apart < -1e-3).any(1) & seen[:, [0, 4, 8]].any(1)).sum()
    assert vanished > 20


@pytest.mark.full
def test_a_still_scene_has_no_moving_pixels_and_no_tracks():
    still = dataclasses.replace(presets.CUBE, motion=None)
    capture, truth = synthetic.make(
        dataclasses.replace(SMALL, things=(presets.WALL, still), skip_every=3)
    )
    assert not capture.moving.any()
    assert truth.track_world.shape == (0, 7, 3)
    assert capture.heldout.tolist() == [1, 4, 7, 8, 9]  # and the skipped instants
    # A still thing seen by a moving camera has flow all the same.
    assert np.abs(truth.flow_forward[0]).max() > 0.5


def test_the_written_directory_reads_back_row_for_row(small, tmp_path, monkeypatch):
    capture, answers = small
    first = synthetic.cached(SMALL, tmp_path)

    def no_scene(*_):
        raise AssertionError("rendered again although cached")

    monkeypatch.setattr(record, "make", no_scene)
    second, stored = synthetic.cached(SMALL, tmp_path)
    for read in (first[0], second):
        assert read.ids == capture.ids
        for name in ("images", "moving", "depths", "times", "train", "heldout"):
            assert np.array_equal(getattr(read, name), getattr(capture, name)), name
        leaves = map(jax.tree.leaves, (read.cameras, capture.cameras))
        for one, two in zip(*leaves, strict=True):
            assert np.allclose(one, two, atol=1e-7)
        assert np.allclose(read.points.position, capture.points.position, atol=1e-7)
        assert (read.near, read.far) == pytest.approx((capture.near, capture.far))
    for one, two in zip(stored, answers, strict=True):
        assert np.array_equal(one, two)
    assert len(list(tmp_path.iterdir())) == 1
    assert nerfies_format.read(next(tmp_path.iterdir())).source == "nerfies"


def test_two_processes_may_fill_the_cache_at_once(small, tmp_path, monkeypatch):
    def make_while_another_finishes(*_):
        monkeypatch.setattr(record, "make", lambda *_: small)
        synthetic.cached(SMALL, tmp_path)
        return small

    monkeypatch.setattr(record, "make", make_while_another_finishes)
    capture, _ = synthetic.cached(SMALL, tmp_path)
    assert capture.ids == small[0].ids
    assert len(list(tmp_path.iterdir())) == 1


def test_a_failed_write_leaves_nothing_behind(small, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(record, "make", lambda *_: small)
    monkeypatch.setattr(truth, "save", full)
    with pytest.raises(ValueError, match="No space left"):
        synthetic.write(SMALL, tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_a_truth_of_another_version_is_refused(tmp_path):
    np.savez(tmp_path / "truth.npz", ids=np.array(["a"]))
    with pytest.raises(ValueError, match="create the scene again"):
        truth.load(tmp_path / "truth.npz")


def test_the_digest_knows_every_setting_and_the_seed():
    specs = list(synthetic.PRESETS.values())
    specs.append(dataclasses.replace(specs[0], point_noise=0.001))
    assert len({synthetic.digest(spec) for spec in specs}) == len(specs)
    assert synthetic.digest(specs[0], 1) != synthetic.digest(specs[0], 0)
    assert synthetic.digest(specs[0]) == synthetic.digest(specs[0])


def test_the_cameras_of_a_rig_take_turns_in_wide_steps():
    spec = synthetic.PRESETS["rig"]
    plan = rendering.schedule(spec, seed=3)
    position = plan.cameras.position[plan.camera_id == 0]
    there, back = position[:12], position[11:23]
    assert len(np.unique(there, axis=0)) == 12
    np.testing.assert_array_equal(back, there[::-1])
    # Without the rows of different height: the turn seen from the target.
    flat = there[:, [0, 2]] - np.array(spec.cameras.target)[[0, 2]]
    turn = np.degrees(np.diff(np.arctan2(flat[:, 0], flat[:, 1])))
    assert ((turn > 7) & (turn < 11)).all()


def test_a_pan_turns_the_view_and_a_zoom_changes_the_focal_length():
    plan = rendering.schedule(synthetic.PRESETS["pan"], seed=0)
    rows = plan.camera_id == 0
    view = plan.cameras.camera_from_world[rows, 2]
    turn = np.degrees(np.arctan2(view[:, 0], -view[:, 2]))
    assert turn.min() < -35
    assert turn.max() > 35
    position = plan.cameras.position[rows]
    assert np.ptp(position, axis=0).max() < 0.1
    assert np.ptp(plan.cameras.focal_px) == 0
    plan = rendering.schedule(synthetic.PRESETS["zoom"], seed=0)
    focal_px = plan.cameras.focal_px[plan.camera_id == 0]
    assert focal_px[0] == pytest.approx(focal_px[-1])
    assert focal_px.max() / focal_px.min() == pytest.approx(1.6, rel=0.01)
    still = synthetic.PRESETS["default"]
    for change in ({"pan_rad": 0.1}, {"zoom": 2.0}):
        moved = dataclasses.replace(still.cameras, **change)
        changed = dataclasses.replace(still, cameras=moved)
        assert synthetic.digest(changed) != synthetic.digest(still)
    for wrong in ({"pan_rad": 2.0}, {"zoom": 0.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            synthetic.Cameras(**wrong)


@pytest.mark.parametrize("settings", [{"count": 1}, {"count": 40}, {"step_rad": 0.0}])
def test_a_rig_without_an_arc_is_refused(settings):
    with pytest.raises(ValueError, match=r"(two cameras|arc of .* between 0 and 3)"):
        synthetic.Rig(**settings)


def test_a_collection_has_an_appearance_for_each_photograph_and_views_to_score():
    collection = synthetic.Collection(masked=True)
    spec = dataclasses.replace(
        synthetic.PRESETS["collection"],
        things=photographed.MONUMENT[:4],
        size=(32, 24),
        frames=9,
        heldout_every=4,
        supersampling=1,
        collection=collection,
    )
    capture, known = synthetic.make(spec)
    np.testing.assert_array_equal(capture.train, np.arange(9))
    np.testing.assert_array_equal(capture.heldout, [9, 10])
    # The views have the appearance of two photographs, but no board.
    np.testing.assert_array_equal(capture.appearance_ids[9:], [2, 6])
    np.testing.assert_array_equal(known.light_gain[9:], known.light_gain[[2, 6]])
    boards = known.transient.any((1, 2))
    assert boards[:9].sum() == 3
    assert not boards[9:].any()
    assert known.thing_names[-1] == "board"
    # Distances of two to eight object sizes, and as many focal lengths as cameras.
    away = np.linalg.norm(capture.cameras.position - collection.target, axis=1)
    assert 2 <= away.min() / collection.object_size <= away.max() / 0.3 <= 8
    assert len(np.unique(capture.cameras.focal_px)) > 8
    stops = np.log2(known.light_gain[:9, 1] / BASE_GAIN)
    assert np.ptp(stops) > 1
    assert np.abs(stops).max() <= 1.5
    # Neither boards nor skies are observed, and points lie on the monument and square.
    shown = (known.things >= 0) & ~known.transient
    np.testing.assert_array_equal(capture.valid, shown)
    assert capture.points.position[:, 1].min() > -0.18
    skies = [capture.images[row][known.things[row] < 0] for row in range(9)]
    skies = np.array([sky.mean(axis=0) for sky in skies if len(sky)])
    assert np.ptp(skies, axis=0).max() > 60
    assert capture.background is capture.flow is None
    with pytest.raises(ValueError, match="remove exposure"):
        dataclasses.replace(spec, exposure=synthetic.Exposure())
