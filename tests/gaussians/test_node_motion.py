"""Motion by control nodes: against loops in NumPy, SciPy's rotations and alignment."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from scipy.spatial.transform import Rotation

from gaussians_jax.core import components, splats
from gaussians_jax.core.protocols import MotionParams
from gaussians_jax.core.splats import Params
from gaussians_jax.init import motion_fit
from gaussians_jax.init.motion_fit import Paths
from gaussians_jax.motion import deformation, skinning
from gaussians_jax.motion import nodes as node_motion
from gaussians_jax.motion.nodes import MaskSpec, NodeMotionSpec
from gaussians_jax.motion.skinning import Links, Moves
from nerfies_jax.nn.encoding import EncodingSpec
from nerfies_jax.training.effects import FrameCondition, PenaltyContext
from tests.gaussians import bound
from tests.gaussians.shared import put, rows_of, some_gaussians
from tests.gradients import directional_error

ROWS, NODES, EXTENT, NAME = 7, 5, 2.0, node_motion.NAME
MOTION = NodeMotionSpec(
    nodes=NODES,
    position=EncodingSpec(1),
    time=EncodingSpec(1),
    depth=1,
    width=4,
    skips=(),
    links=3,
)


MASKED = dataclasses.replace(MOTION, mask=MaskSpec(), rigidity=None)
OF = {"nodes": MOTION, "masked": MASKED}
by_name = pytest.mark.parametrize("name", OF)


@functools.cache
def motion_of(name="nodes"):
    return bound.motion(OF[name], extent=EXTENT)


@functools.cache
def effect(name="nodes"):
    return components.compile_motion(motion_of(name))


def params_of(gaussians, dtype, size=0.5, name="nodes"):
    shapes = jax.eval_shape(lambda: node_motion.init(jax.random.key(0), OF[name]))
    rng = np.random.default_rng(0)
    nets = jax.tree.map(lambda leaf: size * rng.normal(size=leaf.shape), shapes)
    return Params({"splats": rows_of(gaussians)}, {NAME: put(nets, dtype)})


@functools.partial(jax.jit, static_argnames="name")
def moved(params, gaussians, time, name="nodes"):
    ready = effect(name).prepare(params)
    return effect(name).deform(params, gaussians, FrameCondition(time), ready)


def poses(nodes, time):
    """Rotation and shift of each node: the network by hand, in float64."""
    poses, share = [], np.ones(NODES)
    if nodes.mask is not None:
        share = np.clip(1.2 / (1 + np.exp(-nodes.mask)) - 0.1, 0, 1)
    for place, one in zip(nodes.position, share, strict=True):
        features = [place, np.sin(place), np.cos(place), [time, np.sin(time)]]
        hidden = np.concatenate([*features, [np.cos(time)]])
        for layer in nodes.network.hidden:
            hidden = np.maximum(hidden @ layer.weight + layer.bias, 0)
        turn, shift = (
            hidden @ nodes.network.heads[name].weight + nodes.network.heads[name].bias
            for name in ("turn", "shift")
        )
        poses.append((Rotation.from_rotvec(one * turn), EXTENT * one * shift))
    return poses


def expected(nodes, gaussians, time):
    """Means and rotations of Gaussians, one node after the other, in float64."""
    at_time, means, quaternions = poses(nodes, time), [], []
    for mean, (w, *xyz) in zip(gaussians.mean, gaussians.quaternion, strict=True):
        distance = np.linalg.norm(nodes.position - mean, axis=1)
        near = np.argsort(distance)[:3]
        share = np.exp(-((distance / np.exp(nodes.log_radius)) ** 2) / 2)[near]
        share /= share.sum()
        place, mixed = np.zeros(3), np.zeros(4)
        leader = at_time[near[np.argmax(share)]][0].as_quat()
        for one, node in zip(share, near, strict=True):
            turn, shift = at_time[node]
            there = turn.apply(mean - nodes.position[node]) + nodes.position[node]
            place += one * (there + shift)
            mixed += one * turn.as_quat() * np.sign(turn.as_quat() @ leader)
        means.append(place)
        both = Rotation.from_quat(mixed) * Rotation.from_quat([*xyz, w])
        quaternions.append(np.roll(both.as_quat(), 1))
    return np.array(means), np.array(quaternions)


def host(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf).astype(float), tree)


@by_name
@pytest.mark.parametrize("time", [0.0, 0.4])
def test_gaussians_go_where_the_nodes_near_them_carry_them(time, name, dtype):
    gaussians = some_gaussians(ROWS, dtype)
    params = params_of(gaussians, dtype, name=name)
    there = moved(params, gaussians, put(time, dtype), name)
    means, quaternions = expected(host(params.nets[NAME]), host(gaussians), time)
    atol = {"float32": 1e-5, "float64": 1e-13}[dtype]
    np.testing.assert_allclose(there.mean, means, rtol=0, atol=atol)
    same = np.abs(np.sum(quaternions * there.quaternion, axis=1))
    np.testing.assert_allclose(same, 1, atol=atol)
    np.testing.assert_array_equal(there.scale, gaussians.scale)
    assert {leaf.dtype for leaf in there} == {np.dtype(dtype)}


@pytest.mark.full
@by_name
def test_slopes_are_those_of_differences(name, float64):
    gaussians = some_gaussians(ROWS, "float64")
    params = params_of(gaussians, "float64", name=name)
    weights = np.random.default_rng(1).normal(size=(ROWS, 7))
    actual = effect(name).state(params)
    seen, begun = FrameCondition(put(0.3, "float64")), jnp.int32(OF[name].warm_up)
    context = PenaltyContext(seen, begun, jax.random.key(0), None, state=actual)

    def value(nodes, mean, time):
        rows = params.rows["splats"]._replace(mean=mean)
        scene = Params({"splats": rows}, {NAME: nodes})
        there = moved(scene, gaussians._replace(mean=mean), time, name)
        weighted = jnp.sum(
            weights * jnp.concatenate([there.mean, there.quaternion], -1)
        )
        terms = motion_of(name).loss(MotionParams(shared=nodes), context)
        assert set(terms) == {{"nodes": "unrigidity", "masked": "moving"}[name]}
        return weighted + sum(term.value for term in terms.values())

    args = params.nets[NAME], gaussians.mean, put(0.47, "float64")
    assert directional_error(value, *args, step=1e-6) < 1e-6
    # A mask would be closed for good before it shows.
    own = MotionParams(shared=params.nets[NAME])
    early = motion_of(name).loss(own, context._replace(step=begun - 1))
    assert {float(term.weight) for term in early.values()} == {0.0}


def carry(position, log_radius, moves, mean, dtype):
    """Where all nodes together carry one Gaussian, and all slopes of where it is."""
    still = some_gaussians(1, dtype)._replace(mean=put([mean], dtype))
    near = jnp.arange(len(position), dtype=jnp.int32)[None]

    def run(position, log_radius, moves, still):
        by = skinning.displace(position, log_radius, moves, near, still.mean)
        return skinning.apply(still, by)

    args = *put((position, log_radius), dtype), put(moves, dtype), still

    def total(*args):
        there = run(*args)
        return jnp.sum(there.mean) + jnp.sum(there.quaternion)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3)))(*args)
    there = host(jax.jit(run)(*args))
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((there, slopes))]
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    return there.mean[0], there.quaternion[0], host(still.quaternion)[0]


STAY = np.array([1.0, 0, 0, 0])
SIDEWAYS = np.array([[1.0, 0, 0], [0, 1.0, 0]])
TWO = np.array([[0.0, 0, 0], [1.0, 0, 0]])


@pytest.mark.hard_cases
def test_nodes_that_coincide_share_what_they_carry(dtype):
    moves = Moves(np.array([STAY, STAY]), SIDEWAYS)
    mean, *_ = carry(np.zeros((2, 3)), np.zeros(2), moves, [0.3, 0, 0], dtype)
    np.testing.assert_allclose(mean, [0.8, 0.5, 0], atol=1e-6)


@pytest.mark.hard_cases
@pytest.mark.parametrize("away", [30.0, 1e4, 1e6])
def test_far_from_all_nodes_the_nearest_carries_alone(away, dtype):
    moves = Moves(np.array([STAY, STAY]), SIDEWAYS)
    mean, *_ = carry(TWO, np.zeros(2), moves, [0, 0, -away], dtype)
    # As far from either, up to half a unit squared: 0.62 for the nearer of the two.
    share = 1 / (1 + np.exp(-0.5)) if away < 1e3 else mean[0]
    np.testing.assert_allclose(mean[:2], [share, 1 - share], atol=1e-4)
    mean, *_ = carry(TWO, np.zeros(2), moves, [-away, 0, 0], dtype)
    np.testing.assert_allclose(mean[1], 0, atol=1e-6)


@pytest.mark.hard_cases
def test_one_node_carries_as_one_rigid_body(dtype):
    turn = Rotation.from_rotvec([0, 0, np.pi / 2])
    moves = Moves(np.roll(turn.as_quat(), 1)[None], np.zeros((1, 3)))
    one = np.array([[1.0, 0, 0]])
    mean, quaternion, own = carry(one, np.zeros(1), moves, [2.0, 0, 0], dtype)
    np.testing.assert_allclose(mean, [1, 1, 0], atol=1e-6)
    both = turn * Rotation.from_quat(np.roll(own, -1))
    same = abs(np.roll(both.as_quat(), 1) @ quaternion)
    np.testing.assert_allclose(same, 1, atol=1e-6)
    linked = skinning.links(put(np.zeros((1, 4, 3)), dtype), put(np.zeros(1), dtype), 3)
    assert skinning.arap_error(put(one, dtype), put(2 * one, dtype), linked) == 0


@pytest.mark.hard_cases
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-4, np.pi + 1e-4])
def test_opposite_quaternions_are_one_turn(angle, dtype):
    """Half a turn either way: their plain mean has no direction, or a wrong one."""
    half = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    other = np.array([np.cos(np.pi / 2), 0, 0, -np.sin(np.pi / 2)])
    moves = Moves(np.array([half, other]), np.zeros((2, 3)))
    middle = [0.5, 0.2, 0.1]
    _, quaternion, own = carry(TWO, np.zeros(2), moves, middle, dtype)
    turn = Rotation.from_rotvec([0, 0, (angle + np.pi) / 2])
    both = turn * Rotation.from_quat(np.roll(own, -1))
    same = abs(np.roll(both.as_quat(), 1) @ quaternion)
    np.testing.assert_allclose(same, 1, atol=1e-6)


@pytest.mark.hard_cases
@pytest.mark.parametrize("log_radius", [-20.0, -1e3, -np.inf])
def test_a_node_of_no_radius_carries_what_is_on_it_alone(log_radius, dtype):
    moves = Moves(np.array([STAY, STAY]), SIDEWAYS)
    radius = np.array([log_radius, 0.0])
    on_it, *_ = carry(TWO, radius, moves, [0.0, 0, 0], dtype)
    share = 1 / (1 + np.exp(-0.5))
    np.testing.assert_allclose(on_it, [share, 1 - share, 0], atol=1e-6)
    beside, *_ = carry(TWO, radius, moves, [1e-3, 0, 0], dtype)
    np.testing.assert_allclose(beside, [1e-3, 1, 0], atol=1e-6)


def test_what_does_not_move_stays_exactly_and_gets_slopes(dtype):
    gaussians = some_gaussians(ROWS, dtype)
    params = params_of(gaussians, dtype)
    rest = jax.tree.map(jnp.zeros_like, params.nets[NAME].network.heads)
    nodes = params.nets[NAME]
    nodes = nodes._replace(network=nodes.network._replace(heads=rest))
    still = params._replace(nets={NAME: nodes})
    time = put(0.3, dtype)
    np.testing.assert_array_equal(moved(still, gaussians, time).mean, gaussians.mean)
    grads = jax.jit(jax.grad(lambda p: jnp.sum(moved(p, gaussians, time).mean)))(still)
    heads = grads.nets[NAME].network.heads
    assert min(np.abs(heads[name].weight).max() for name in heads) > 1e-3


def a_body(dtype, points=12):
    rng = np.random.default_rng(0)
    before = rng.normal(size=(points, 3))
    index = np.array(
        [rng.permutation(np.delete(np.arange(points), k))[:4] for k in range(points)]
    )
    weight = rng.uniform(0.1, 1, index.shape)
    weight /= weight.sum(axis=1, keepdims=True)
    return before, Links(put(index, np.int32), put(weight, dtype))


def test_rigid_bodies_do_not_bend_and_others_do_by_what_is_left(dtype):
    before, linked = a_body(dtype)
    turn = Rotation.from_rotvec([1.0, -2.0, 0.4])
    rigid = turn.apply(before) + np.array([3.0, 0, 1])
    run = jax.jit(skinning.arap_error)
    small = {"float32": 1e-10, "float64": 1e-27}[dtype]
    assert run(*put((before, rigid), dtype), linked) < small
    # Mirrored, no turn helps: `align_vectors` finds the best there is.
    after = rigid * [1, 1, -1] + 0.1 * np.random.default_rng(1).normal(size=rigid.shape)
    total = 0.0
    for node, (near, weight) in enumerate(zip(*host(linked), strict=True)):
        edges = [places[node] - places[near.astype(int)] for places in (before, after)]
        _, off = Rotation.align_vectors(*edges, weights=weight)
        total += off**2
    value = run(*put((before, after), dtype), linked)
    np.testing.assert_allclose(value, total / len(before), rtol=1e-5)


def test_links_are_to_what_stays_near_over_the_video(dtype):
    """The third node passes the first closely and is gone afterwards."""
    time = np.linspace(0, 1, 5)
    paths = np.zeros((4, 5, 3))
    paths[1, :, 0], paths[3, :, 0] = 1.0, 3.0
    paths[2, :, 0] = 0.1 + 10 * time
    linked = skinning.links(put(paths, dtype), put(np.zeros(4), dtype), 2)
    assert linked.neighbor[0].tolist() == [1, 3]
    share = np.exp([-0.5, -4.5])
    np.testing.assert_allclose(linked.weight[0], share / share.sum(), rtol=1e-5)


def test_what_is_found_when_rows_change_is_what_is_found_when_drawn():
    gaussians = some_gaussians(ROWS, "float32")
    params = params_of(gaussians, "float32")
    actual, ready = effect().state(params), effect().prepare(params)
    np.testing.assert_array_equal(actual.near, ready.near)
    distance = np.linalg.norm(
        np.asarray(gaussians.mean)[:, None] - params.nets[NAME].position, axis=2
    )
    np.testing.assert_array_equal(actual.near, np.argsort(distance, axis=1)[:, :3])


def test_training_searches_only_when_rows_change():
    """What is near comes from the state, right or wrong."""
    gaussians = some_gaussians(ROWS, "float32")
    params = params_of(gaussians, "float32")
    condition = FrameCondition(put(0.4, "float32"), jnp.int32(50), jax.random.key(0))
    effects = (effect(),)
    actual = effect().state(params)
    other = actual._replace(near=(actual.near + 1) % NODES)

    def run(states):
        return deformation.deform_in_training(
            effects, params, gaussians, condition._replace(step=4000), states
        )

    fresh = run(None).mean
    np.testing.assert_array_equal(run({NAME: actual}).mean, fresh)
    assert np.abs(run({NAME: other}).mean - fresh).max() > 1e-2


def test_nodes_are_spread_out_and_as_wide_as_their_neighbors_are_far():
    points = np.concatenate([np.zeros((50, 3)), np.eye(3) * [1.0, 2.0, 5.0]])
    chosen = points[skinning.farthest_points(points, 9)]
    assert len(chosen) == 4  # that differ
    assert sorted(np.abs(chosen).max(axis=1)) == [0, 1, 2, 5]
    np.testing.assert_array_equal(chosen[0], [0, 0, 5])
    rows = rows_of(some_gaussians(ROWS, "float32"))
    placed = effect().init(jax.random.key(0), rows).shared
    apart = np.linalg.norm(placed.position[:, None] - placed.position, axis=2)
    near = np.sort(apart, axis=1)[:, 1:4]
    radius = np.sqrt(np.mean(near**2, axis=1))
    np.testing.assert_allclose(np.exp(placed.log_radius), radius, rtol=1e-5)
    assert apart[apart > 0].min() > 0.1


@pytest.mark.full
def test_nodes_at_rest_stay_at_rest_when_others_are_fitted_to_paths():
    rng, time = np.random.default_rng(0), np.linspace(0, 1, 12)
    start = rng.normal(0, 0.1, (30, 3))
    position = start[:, None] + time[:, None] * [0.5, 0, 0]
    still = rng.uniform(-1, 1, (200, 3)) + np.array([0, 0, 2.0])
    paths = Paths(time, position, np.ones((30, 12), bool), 1.0, still)
    small = dataclasses.replace(MOTION, nodes=16, depth=2, width=32)
    motion = bound.record(small, extent=EXTENT)
    fitted = motion_fit.fit(motion, paths, jax.random.key(0), steps=400)
    assert fitted.last < 0.02
    nodes = fitted.points.nets
    assert (np.asarray(nodes.position)[:8, 2] < 0.5).all()  # half of them move
    shift = node_motion.moves(nodes, small, EXTENT, jnp.float32(1)).shift
    assert np.linalg.norm(shift[8:], axis=1).max() < 0.05
    assert splats.neighbor_distance(still, 1.0).min() > 0


def test_nothing_is_computed_for_what_only_resting_nodes_carry():
    """Two blocks of rows, the second far away on nodes that are closed."""
    rows = 2 * node_motion.ROWS_AT_ONCE
    gaussians = some_gaussians(rows, "float32")
    far = np.repeat([0.0, 50.0], node_motion.ROWS_AT_ONCE)[:, None]
    near = 0.1 * np.asarray(gaussians.mean) + far
    gaussians = gaussians._replace(mean=put(near, "float32"))
    nodes = params_of(gaussians, "float32", name="masked").nets[NAME]
    away = np.array([0, 0, 50, 50, 50.0])
    shut = np.array([1, 0, -2.5, -10, -1e30])
    nodes = nodes._replace(
        position=put(np.asarray(nodes.position) + away[:, None], "float32"),
        mask=put(shut, "float32"),
    )
    two = bound.record(dataclasses.replace(MASKED, near=2), extent=EXTENT)
    params = Params({"splats": rows_of(gaussians)}, {NAME: nodes})

    @jax.jit
    def run(params):
        ready = two.prepare(params)
        there = two.deform(params, gaussians, FrameCondition(jnp.float32(0.3)), ready)
        return there.mean

    there, mean = np.asarray(run(params)), np.asarray(gaussians.mean)
    moving = np.asarray(two.state(params).moving)
    np.testing.assert_array_equal(moving, far[:, 0] == 0)
    np.testing.assert_array_equal(there[~moving], mean[~moving])
    assert (there[moving] != mean[moving]).any(axis=1).all()
    # A block that is passed over does not even see what is no number.
    broken = nodes._replace(log_radius=nodes.log_radius.at[2:].set(jnp.nan))
    there = np.asarray(run(params._replace(nets={NAME: broken})))
    np.testing.assert_array_equal(there[~moving], mean[~moving])
    slope = jax.grad(lambda mask: jnp.sum(node_motion.openness(mask)))(nodes.mask)
    assert (np.asarray(slope) > 0).tolist() == [True, True, False, False, False]


@jax.jit
def mask_terms(nodes, time):
    """Openness, the loss of the mask, and the slopes of that and of what moves."""
    begun = jnp.int32(MASKED.warm_up)
    context = PenaltyContext(FrameCondition(time), begun, None, None)

    def loss(nodes):
        own = MotionParams(shared=nodes)
        return motion_of("masked").loss(own, context)["moving"].value

    def motion(nodes):
        now = node_motion.moves(nodes, MASKED, EXTENT, time)
        return jnp.sum(now.turn) + jnp.sum(now.shift)

    share = node_motion.openness(nodes.mask)
    return share, loss(nodes), jax.grad(loss)(nodes), jax.grad(motion)(nodes)


@pytest.mark.hard_cases
@pytest.mark.parametrize("far", [50.0, 1e4])
def test_a_mask_that_is_decided_is_exact_and_has_finite_slopes(far, dtype):
    mask = np.array([-far, far, -2.0, 0.5, far])
    nodes = params_of(some_gaussians(ROWS, dtype), dtype, name="masked").nets[NAME]
    nodes = nodes._replace(mask=put(mask, dtype))
    share, loss, of_loss, of_motion = host(mask_terms(nodes, put(0.3, dtype)))
    logistic = scipy.special.expit(mask)
    atol = {"float32": 1e-6, "float64": 1e-14}[dtype]
    between = np.array([False, False, True, True, False])
    stretched = np.where(between, 1.2 * logistic - 0.1, mask > 0)
    np.testing.assert_allclose(share, stretched, rtol=0, atol=atol)
    np.testing.assert_array_equal(share[~between], (mask > 0)[~between])
    np.testing.assert_allclose(loss, np.mean(logistic), rtol=0, atol=atol)
    slope = logistic * (1 - logistic) / NODES
    np.testing.assert_allclose(of_loss.mask, slope, rtol=0, atol=atol)
    # What a node does moves a mask between shut and open, and no other.
    np.testing.assert_array_equal(of_motion.mask != 0, between)
    for leaf in jax.tree.leaves((of_loss, of_motion)):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sparsity": -1.0}, "sparsity=-1.0 must be finite"),
        ({"nodes": 0}, "nodes=0 must be at least 1"),
        ({"near": 0}, "near=0 must be at least 1"),
        ({"rigidity": 0.0}, "None disables"),
        ({"moving_share": 0.0}, "must lie in"),
        ({"warm_up": -1}, "must not be negative"),
        ({"radius_rate": -1.0}, "finite and not negative"),
        ({"learning_rate": 1e-9}, "the rate falls"),
        ({"width": 0}, "width >= 1"),
    ],
)
def test_no_motion_of_nothing(changes, words):
    of = MASKED.mask if "sparsity" in changes else MOTION
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(of, **changes)


def test_the_extent_of_the_scene_is_not_compiled_into_the_neighborhoods():
    params = params_of(some_gaussians(ROWS, "float32"), "float32")
    own = MotionParams(shared=params.nets[NAME])
    node_motion._find_linked.clear_cache()
    for extent in (EXTENT, 1.1 * EXTENT):
        bound.motion(MOTION, extent=extent).refresh(own, params.rows["splats"])
    assert node_motion._find_linked._cache_size() == 1


def test_without_rigidity_and_mask_nothing_is_found_for_them_and_nothing_costs():
    plain = dataclasses.replace(MOTION, rigidity=None)
    motion = bound.motion(plain, extent=EXTENT)
    context = PenaltyContext(FrameCondition(None), jnp.int32(9), None, None)
    params = params_of(some_gaussians(ROWS, "float32"), "float32")
    own = MotionParams(shared=params.nets[NAME])
    assert motion.loss(own, context) == {}
    state = motion.refresh(own, params.rows["splats"])
    assert state.links is None
    assert state.moving is None
    free = dataclasses.replace(MASKED, mask=MaskSpec(sparsity=0.0))
    own = MotionParams(shared=None)
    assert bound.motion(free, extent=EXTENT).loss(own, context) == {}
