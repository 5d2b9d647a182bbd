"""Synthetic scenes again, in NumPy float64, from the equations in their docstrings.

Nothing is imported from the renderer but the settings' attributes. Points are [n, 3].
"""

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

NOTHING = -1


def rotation(axis, angle_rad):
    axis = np.asarray(axis, float)
    return Rotation.from_rotvec(angle_rad * axis / np.linalg.norm(axis)).as_matrix()


def pose(thing, time):
    """4x4 world_from_body."""
    world = np.eye(4)
    world[:3, 3] = thing.place
    motion = thing.motion
    kind = type(motion).__name__
    if kind == "Path":
        waves = 2 * np.pi * (np.array(motion.cycles) * time + np.array(motion.phase))
        world[:3, 3] += np.array(motion.sway) * np.sin(waves)
        world[:3, :3] = rotation(motion.axis, 2 * np.pi * motion.turns * time)
    elif kind == "Arm":
        chain = np.eye(4)
        for hinge in motion.hinges:
            swing = np.sin(2 * np.pi * (hinge.cycles * time + hinge.phase))
            turn = np.eye(4)
            turn[:3, :3] = rotation(
                hinge.axis, hinge.rest_rad + hinge.swing_rad * swing
            )
            to_pivot = np.eye(4)
            to_pivot[:3, 3] = hinge.pivot
            chain = chain @ to_pivot @ turn @ np.linalg.inv(to_pivot)
        world = chain @ world
    elif kind == "Glide":
        share = np.clip((time - motion.start) / (motion.stop - motion.start), 0, 1)
        world[:3, 3] += share * np.array(motion.travel)
    return world


def undeform(shape, points, time):
    points = np.array(points, float)
    kind = type(shape).__name__
    if kind == "Sphere" and shape.squash is not None:
        squash = shape.squash
        log = squash.amount * np.sin(2 * np.pi * (squash.cycles * time + squash.phase))
        foot = np.array([0, -shape.radius, 0])
        stretch = np.exp(log * np.array([-0.5, 1, -0.5]))
        return (points - foot) / stretch + foot
    if kind == "Sheet":
        x, y, z = points.T
        hang = (shape.half_height - y) / (2 * shape.half_height)
        u = x - shape.sway * hang**2 * np.sin(2 * np.pi * shape.sway_cycles * time)
        k, turn = 2 * np.pi / shape.wavelength, 2 * np.pi * shape.billow_cycles * time
        wave = np.sin(k * (u + 0.5 * y) - turn)
        ripple = 0.35 * np.sin(k * (1.7 * y - 0.6 * u) - 2 * turn)
        return np.stack([u, y, z - shape.billow * hang * (wave + ripple)], -1)
    return points


def deform(shape, material, time):
    material = np.array(material, float)
    # The inverse of a map that only stretches or only shears: two steps of correction.
    if type(shape).__name__ == "Sheet":
        point = material.copy()
        for _ in range(2):  # first u from x, then w from z
            point += material - undeform(shape, point, time)
        return point
    if type(shape).__name__ == "Sphere":
        zero = undeform(shape, np.zeros((1, 3)), time)[0]
        grad = undeform(shape, np.eye(3), time) - zero
        return np.linalg.solve(grad.T, (material - zero).T).T
    return material


def to_body(thing, points, time):
    return (np.c_[points, np.ones(len(points))] @ np.linalg.inv(pose(thing, time)).T)[
        :, :3
    ]


def observe(thing, canonical, time):
    material = undeform(thing.shape, to_body(thing, canonical, 0.0), 0.0)
    body = deform(thing.shape, material, time)
    return (np.c_[body, np.ones(len(body))] @ pose(thing, time).T)[:, :3]


def canonical(thing, points, time):
    """Where the points seen at `time` were at zero."""
    material = undeform(thing.shape, to_body(thing, points, time), time)
    body = deform(thing.shape, material, 0.0)
    return (np.c_[body, np.ones(len(body))] @ pose(thing, 0.0).T)[:, :3]


def enters(thing, origin, direction, time):
    """Distance (in lengths of the direction) of one ray's first entry, or infinity."""
    inverse = np.linalg.inv(pose(thing, time))
    start, along = (
        inverse[:3, :3] @ origin + inverse[:3, 3],
        inverse[:3, :3] @ direction,
    )
    shape = thing.shape

    def material(s):
        points = start + np.atleast_1d(s)[:, None] * along
        return undeform(shape, points, time)

    distances = {"Sphere": _ball, "Box": _box, "Sheet": _sheet}[type(shape).__name__](
        shape, start, along, material
    )
    return min((s for s in distances if s > 0), default=np.inf)


def _ball(shape, start, along, material):
    samples = np.array([-1.0, 0.0, 1.0])
    value = np.sum(material(samples) ** 2, -1) - shape.radius**2
    roots = np.roots(np.polyfit(samples, value, 2))
    return [root.real for root in roots if abs(root.imag) < 1e-12]


def _box(shape, start, along, material):
    half = np.array(shape.half)
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for side in (-1, 1):
            s = (side * half[axis] - start[axis]) / along[axis]
            if np.all(np.abs((start + s * along)[others]) <= half[others]):
                yield s


def _sheet(shape, start, along, material):
    near = np.linalg.norm(start) / np.linalg.norm(along)
    reach = 0.5 / np.linalg.norm(along)
    grid = np.linspace(near - reach, near + reach, 3001)
    height = material(grid)[:, 2]
    for i in np.flatnonzero(height[:-1] * height[1:] < 0):
        s = brentq(lambda s: material(s)[0, 2], grid[i], grid[i + 1], xtol=1e-15)
        u, v, _ = material(s)[0]
        if abs(u) <= shape.half_width and abs(v) <= shape.half_height:
            yield s


def first(things, origin, direction, time):
    """(distance, id) of the first thing one ray meets."""
    distances = [enters(thing, origin, direction, time) for thing in things]
    best = int(np.argmin(distances))
    return distances[best], best if np.isfinite(distances[best]) else NOTHING


def directions(camera, pixels):
    """World directions of z-depth one of a camera without distortion."""
    grads = (pixels - camera.principal_point_px) / camera.focal_px
    return np.c_[grads, np.ones(len(grads))] @ camera.camera_from_world.astype(float)


def project(camera, points):
    lateral = (points - camera.position) @ camera.camera_from_world.astype(float).T
    return lateral[:, :2] / lateral[:, 2:] * camera.focal_px + camera.principal_point_px
