"""Paths of rigidly moving objects, refined by bundle adjustment.

Paths of least acceleration treat each track separately. For an object that accelerates
more than the camera, they are too near in some frames and too far in others. The size
of the object in the images determines its distance better, up to one factor for the
whole video. This factor is computed from the paths, whose errors have either sign, and
from the likelihood of the motion that it implies (`body_scale.most_likely`).
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from nerfies_jax.preprocessing import body_scale, bundle, rigid_groups, static_points
from nerfies_jax.preprocessing.bundle import Body
from nerfies_jax.preprocessing.paths import Paths
from nerfies_jax.preprocessing.static_points import track_rays
from nerfies_jax.preprocessing.tracks import TRACK_PX, Tracks
from nerfies_jax.preprocessing.view_set import Views

GROUPS = 12
FEWEST = 20  # tracks of a body
MOST = 300  # tracks in the adjustment. Points of other tracks are fitted afterwards.
# Frames in the adjustment, whose work grows with their third power. Longer videos are
# subsampled.
MOST_FRAMES = 80
LEAST_SHARE = 0.5  # of the tracks of a group that a body must explain
# Maximum errors in pixels of the tracks of a rigid body, of its median track, and of
# the latter in the first round, before the body is extended. In the built-in scenes,
# medians of rigid objects are 0.10 to 0.14, and 0.13 to 0.23 in the first round. Those
# of a cloth are 0.25 to 0.30, and of a ball that is squashed 0.18 to 0.23 in the end.
WITHIN_PX, PRECISE_PX, FIRST_PX = 0.4, 0.15, 0.25
ROUGHLY_PX = 2 * TRACK_PX  # of the tracks of other bodies
# Relative deviation of depths above which rigid bodies are refined. The depth of a
# sliding shutter is wrong by 4 % with an estimated deviation of 3 %, and a cube with
# the same deviation is turned by up to 6 degrees in a frame.
DOUBTFULLY_TOLD = 0.02
# Above this one, bodies with a median error of up to `TRACK_PX` are refined as well, if
# they are not parts of an object: those of the squashed ball have scales that differ by
# 8 %.
BADLY_TOLD, MOST_OF_OBJECT = 0.05, 0.7
# Logarithm of the likelihood ratio from which the factor of a rigid body is applied.
# The confidence is 95 % (Wilks 1938, one degree of freedom). Rigid objects of the
# built-in scenes whose paths are 0 to 1.2 % from the true distance have 0 to 1, with
# factors that are wrong by up to 3.7 %, and shutters that are 4 % from it have 8 to 13.
# That of the squashed ball, 5 % from it, is below 0.5.
LEAST_NATS = 2.0
# Weight of second differences of the poses of a body in 60 frames. It grows with the
# square of the number of frames, so that a motion costs the same at any frame rate.
# Drift of tracks looks like motion along the rays: with 0.1 px, the depth of a forearm
# has a median error of 3.8 % instead of 1.8 % (2.3 % with 10 px).
BEND_PX, BEND_FRAMES = 100.0, 60
# Groups of objects that are not rigid, whose scale alone is refined. In 12 groups, a
# ball that is squashed has three, with scales that differ by 8 %.
LARGE_GROUPS = 6
FEWEST_SEEN = 6  # visible tracks that determine the pose of a body in a frame
GROWTHS = 5  # rounds in which a body is extended to more frames
LEAST_KNOWN = 6  # frames in which a path is known
# Frames that a track must share with a body that grows. A cube that turns fast shows
# another side after 12 frames. With 6 common frames the body does not reach its first
# side, whose depth remains wrong by up to 5 %, and with 3 by up to 2 %.
LEAST_SHARED = 3
# Paths of short tracks are too uncertain for grouping, so the tracks that one object
# explains are found by its adjustment, with more tracks in fewer frames.
MOST_OF_SHORT, MOST_BODIES = 1000, 3
ROUNDS_OF_SHORT = 3  # work relative to that of long tracks
LEAST_OF_SHORT = 0.1  # minimum share of all tracks that another object is sought in
MOST_DEVIATION = (
    0.25  # of a scale from smoothness. Otherwise that of the paths is used.
)


def refined(
    views: Views,
    tracks: Tracks,
    paths: Paths,
    has_room: Callable[[int], bool] = lambda terms: True,
) -> Paths:
    """Refine the paths on rigid objects, and the scale of others.

    Only objects with inaccurate depth are refined. Otherwise the errors of a nearly
    rigid cloth would become four times larger. A track is no longer known in frames
    that show too little of its object. Paths on objects that are not rigid keep their
    form, and are scaled about the cameras by one factor for each object.

    Args:
      views: The frames.
      tracks: The tracks.
      paths: Their paths.
      has_room: Called before each object and each round of its growth with its work,
        the number of tracks times the squared number of frames. False ends refinement.

    Returns:
      The paths.
    """
    position, is_known = paths.position.copy(), paths.known.copy()
    is_rigid = paths.is_rigid.copy()
    every = -(-len(views.time) // MOST_FRAMES)
    some_views, some_tracks, some_paths = _some_frames(views, tracks, paths, every)
    left = some_paths.known.sum(1) >= LEAST_KNOWN
    if left.sum() < FEWEST:
        return paths
    rows = np.flatnonzero(left)
    label = np.full(len(left), -1)
    label[rows] = rigid_groups.labels(
        some_paths.position[rows], some_paths.known[rows], GROUPS
    )
    candidates = rows
    for group in np.argsort(-np.bincount(label[rows], minlength=GROUPS), kind="stable"):
        own = np.flatnonzero((label == group) & left)
        if len(own) < FEWEST:
            continue
        deviation = np.median(paths.depth_deviation[own])
        if deviation < DOUBTFULLY_TOLD:
            continue
        if not has_room(_work(own, some_paths)):
            break
        rows = np.flatnonzero(left)
        within = TRACK_PX if deviation >= BADLY_TOLD else PRECISE_PX
        growth = _grow(some_views, some_tracks, some_paths, own, rows, within, has_room)
        if growth is None:
            continue
        own, body, error_px = growth
        if error_px > PRECISE_PX and _is_part(some_paths, candidates, own):
            continue
        if every > 1:
            body = _in_all_frames(views, tracks, paths, own, body, every)
        body, is_known[own] = _at_paths_scale(views, paths, own, body)
        factor = _likely_factor(views, paths, own, body, every, LEAST_NATS)
        position[own] = bundle.scaled(views, body, factor).world()
        is_rigid[own] = error_px <= PRECISE_PX
        left[own] = False
    rows = np.flatnonzero(left)
    for own in _doubtful_groups(some_paths, rows):
        if has_room(_work(own, some_paths)):
            factor = _factor_of_group(some_views, some_tracks, some_paths, own)
            offset = position[own] - views.position
            position[own] = views.position + factor * offset
    depth = views.depth_of(position)
    return Paths(position, is_known, depth, paths.depth_deviation, is_rigid)


def _is_part(paths, rows, own):
    """Test if tracks are a part of the group that moves together with most of them."""
    label = rigid_groups.labels(paths.position[rows], paths.known[rows], LARGE_GROUPS)
    counts = np.bincount(label[np.isin(rows, own)])
    return counts.max() < MOST_OF_OBJECT * (label == counts.argmax()).sum()


def _doubtful_groups(paths, rows):
    """Return the groups of tracks that move together and whose depth is inaccurate."""
    if len(rows) < FEWEST:
        return []
    label = rigid_groups.labels(paths.position[rows], paths.known[rows], LARGE_GROUPS)
    groups = [rows[label == group] for group in np.unique(label)]
    deviation = paths.depth_deviation
    return [
        own
        for own in groups
        if len(own) >= FEWEST and np.median(deviation[own]) >= BADLY_TOLD
    ]


def refined_short(
    views: Views,
    tracks: Tracks,
    paths: Paths,
    least_known: int,
    has_room: Callable[[int], bool] = lambda terms: True,
) -> Paths:
    """Fit rigid objects to tracks of few frames, whose own paths are too near.

    The scale of an object follows from the smoothness of its motion, where this
    determines it. Other paths are not known, unless no object is found and they are
    long.

    Args:
      views: The frames.
      tracks: The tracks.
      paths: Their paths.
      least_known: Minimum number of frames of a path on an object.
      has_room: As for `refined`.

    Returns:
      The paths.
    """
    position, is_known = paths.position.copy(), paths.known.copy()
    deviation = paths.depth_deviation.copy()
    is_known[is_known.sum(1) < LEAST_KNOWN] = False
    left = tracks.visible.sum(1) >= least_known
    fewest = max(FEWEST, LEAST_OF_SHORT * left.sum())
    for number in range(MOST_BODIES):
        rows = np.flatnonzero(left)
        if len(rows) < fewest or not has_room(
            ROUNDS_OF_SHORT * _work(rows, paths, MOST_OF_SHORT)
        ):
            break
        flat = _at_one_depth(views, tracks, paths)
        rigid_fit = _body(views, tracks, flat, rows, MOST_OF_SHORT)
        if rigid_fit is None:
            break
        own, body = rigid_fit
        there = flat.known[own].sum(0) >= FEWEST_SEEN
        body, miss = _on(views, tracks, flat, body, rows, there, least_known)
        fits = miss < ROUGHLY_PX
        if fits.sum() < FEWEST:
            break
        own, body = rows[fits], body._replace(point=body.point[fits])
        visible = tracks.visible[own] & there
        frames = np.flatnonzero(visible.sum(0) >= FEWEST_SEEN)
        center = body.world()[:, frames].mean(0)
        scale = body_scale.from_smoothness(
            views.time[frames], views.position[frames], center
        )
        is_determined = scale.deviation < MOST_DEVIATION
        if number and not is_determined:
            break
        if is_determined:
            position[own] = bundle.scaled(views, body, scale.factor).world()
            is_known[own] = visible
        else:
            position[own], is_known[own] = _at_paths_scale(views, paths, own, body)
        deviation[own] = scale.deviation
        left[own] = False
        is_known[left] = False
    depth = views.depth_of(position)
    is_known &= np.nan_to_num(depth, nan=-1.0) > 0
    return Paths(position, is_known, depth, deviation, paths.is_rigid)


def _at_one_depth(views, tracks, paths):
    """Place all points at one depth.

    The adjustment of a rigid object converges from there, while paths of few frames are
    at depths that differ by more than the size of the object.
    """
    depth = np.median(paths.depth[paths.known]) if paths.known.any() else 1.0
    position = views.position + depth * track_rays(views, tracks)
    position = np.where(tracks.visible[..., None], position, np.nan)
    return paths._replace(
        position=position,
        known=tracks.visible,
        depth=np.where(tracks.visible, depth, np.nan),
    )


def _work(own, paths, most=MOST):
    return min(len(own), most) * paths.known.shape[1] ** 2


def _some_frames(views, tracks, paths, every):
    """Select views, tracks and paths of every `every`-th frame."""
    if every == 1:
        return views, tracks, paths
    step = slice(None, None, every)
    rarer = {
        name: getattr(paths, name)[:, step] for name in ("position", "known", "depth")
    }
    return (
        Views(*(part[step] for part in views)),
        Tracks(tracks.start // every, tracks.pixel[:, step], tracks.visible[:, step]),
        paths._replace(**rarer),
    )


def _in_all_frames(views, tracks, paths, own, body, every):
    """Extend a body of every `every`-th frame to all frames."""
    frames = np.arange(len(views.time))
    keyframes = frames[::every]
    within = np.minimum(frames, keyframes[-1])  # it stays where it was last
    turn = Slerp(keyframes, Rotation.from_matrix(body.rotation))(within).as_matrix()
    shift = np.stack([np.interp(within, keyframes, axis) for axis in body.shift.T], -1)
    some = np.isin(own, _fewer(paths, own))
    sight = bundle.sight(views, tracks.take(own[some]), paths.known[own[some]])
    posed_body = bundle.posed(views, sight, Body(body.point[some], turn, shift))
    return posed_body._replace(point=body.point)


def _grow(views, tracks, paths, own, rows, within, has_room):
    """Return the paths on the rigid object of `own`, it, and its error, or None.

    The object is extended to more frames by tracks that are visible there. Its median
    error must be `within` pixels in the end.
    """
    body, selection = None, None
    bend_px = BEND_PX * (len(views.time) / BEND_FRAMES) ** 2
    for _ in range(GROWTHS):
        before, selection = selection, _fewer(paths, own)
        if np.array_equal(before, selection):
            break  # another round would repeat the last one
        rigid_fit = _body(views, tracks, paths, own, MOST, bend_px, WITHIN_PX)
        if rigid_fit is None:
            break
        own, body = rigid_fit
        there = paths.known[own].sum(0) >= FEWEST_SEEN
        whole, miss = _on(views, tracks, paths, body, rows, there, LEAST_SHARED)
        fits = miss < WITHIN_PX
        if not fits.any() or np.median(miss[fits]) > max(within, FIRST_PX):
            return None
        if fits.sum() <= len(own) or not has_room(_work(rows[fits], paths)):
            break
        own = rows[fits]
        whole = whole._replace(point=whole.point[fits])
        paths = _rescale_paths(views, paths, own, whole, there)
    if body is None:
        return None
    body, miss = _on(views, tracks, paths, body, rows, there)
    fits = miss < WITHIN_PX
    error_px = np.median(miss[fits]) if fits.any() else np.inf
    if fits.sum() < FEWEST or error_px > within:
        return None
    return rows[fits], body._replace(point=body.point[fits]), error_px


def _rescale_paths(views, paths, own, body, there):
    """Scale the paths on a body to its depth in the frames `there`.

    Paths of different scales initialize parts of an object that do not fit together,
    which the robust loss would accept.
    """
    common_depth = np.where(paths.known[own] & there, paths.depth[own], np.nan)
    ratio = views.depth_of(body.world()) / common_depth
    factor = np.nanmedian(ratio, axis=1)[:, None]
    position, depth = paths.position.copy(), paths.depth.copy()
    offset = position[own] - views.position
    position[own] = views.position + factor[..., None] * offset
    depth[own] *= factor
    return paths._replace(position=position, depth=depth)


def _body(
    views, tracks, paths, own, most=MOST, bend_px=bundle.BEND_PX, within=ROUGHLY_PX
):
    """Return tracks on one rigid object, and the object, or None."""
    own = _fewer(paths, own, most)
    for _ in range(2):  # a second time without the outliers
        body = _first(paths, own)
        sight = bundle.sight(views, tracks.take(own), paths.known[own])
        body = bundle.adjusted(views, sight, body, bend_px)
        miss = bundle.misses(views, sight, body)
        fits = bundle.typical_misses(sight, miss, len(own)) < within
        if fits.mean() < LEAST_SHARE or fits.sum() < FEWEST:
            return None
        own, all_fit = own[fits], fits.all()
        if all_fit:
            break
    return own, body


def _fewer(paths, own, most=MOST):
    """Select at most `most` tracks, first those visible in frames with few tracks."""
    rare = paths.known[own] / np.maximum(paths.known[own].sum(0), 1)
    return own[np.argsort(-rare.sum(1), kind="stable")[:most]]


def _first(paths, own):
    """Initialize a body from the paths."""
    position, is_known = paths.position[own], paths.known[own]
    canonical = position.shape[1] // 2
    motion = rigid_groups.motion(position, is_known, np.zeros(len(own), int), canonical)
    point, (middle,) = rigid_groups.centers(position, is_known, motion)
    shift = motion.shift[0] + motion.rotation[0] @ middle
    return Body(point - middle, motion.rotation[0], shift)


def _on(views, tracks, paths, body, rows, there, least_known=LEAST_KNOWN):
    """Return the body with a point for each path, and reprojection errors in px.

    Only the frames `there` are used. The error is infinite if a path is known in too
    few of them.
    """
    is_known = paths.known[rows] & there
    enough = is_known.sum(1) >= least_known
    # The body is a static scene before cameras that move relative to it.
    turn = np.swapaxes(body.rotation, 1, 2)
    relative = views._replace(
        rotation=views.rotation @ body.rotation,
        position=np.einsum("fij,fj->fi", turn, views.position - body.shift),
    )
    tracks = tracks.take(rows)
    known_tracks = tracks._replace(visible=is_known)
    point = static_points.fit(relative, known_tracks).position
    point[~enough] = 0.0
    sight = bundle.sight(views, tracks, is_known & enough[:, None])
    whole = bundle.placed(views, sight, body._replace(point=point))
    miss = bundle.misses(views, sight, whole)
    return whole, bundle.typical_misses(sight, miss, len(rows))


def _at_paths_scale(views, paths, own, body):
    """Return a body scaled to the median depth of its paths, and where it is known."""
    enough = paths.known[own].sum(0) >= FEWEST_SEEN
    is_known = paths.known[own] & enough
    depth = views.depth_of(body.world())
    is_known &= depth > 0
    factor = np.median(paths.depth[own][is_known] / depth[is_known])
    return bundle.scaled(views, body, factor), is_known


def _likely_factor(views, paths, own, body, every=1, least_nats=0.0):
    """Return the most likely factor of a body at the scale of its paths."""
    frames = np.flatnonzero(paths.known[own].sum(0) >= FEWEST_SEEN)[::every]
    center = body.world()[:, frames].mean(0)
    deviation = float(np.median(paths.depth_deviation[own]))
    return body_scale.most_likely(
        views.time[frames], views.position[frames], center, deviation, least_nats
    )


def _factor_of_group(views, tracks, paths, own):
    """Return the factor of an object that is only roughly rigid, 1 if it is not."""
    rigid_fit = _body(views, tracks, paths, own)
    if rigid_fit is None:
        return 1.0
    part, body = rigid_fit
    there = paths.known[part].sum(0) >= FEWEST_SEEN
    if not there.any():
        return 1.0
    body, _ = _on(views, tracks, paths, body, part, there)
    body, _ = _at_paths_scale(views, paths, part, body)
    return _likely_factor(views, paths, part, body)
