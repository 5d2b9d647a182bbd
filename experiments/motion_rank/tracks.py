"""Trajectories to fit motions to: rigid groups, cloth, points on their own, a scene."""

import dataclasses
from typing import NamedTuple

import numpy as np

BLOBS = 4  # rigid groups


class Tracks(NamedTuple):
    """Points and how far they are from their rest at each time."""

    rest: np.ndarray  # [points, 3] in [-1, 1]
    times: np.ndarray  # [times] in [0, 1]
    moved: np.ndarray  # [points, times, 3]; root mean square length one half


def make(kind: str, points: int, times: int, seed: int) -> Tracks:
    """One of `KINDS`, drawn anew for each seed."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    instants = np.linspace(0, 1, times)
    rest, path = KINDS[kind](rng, points, instants)
    moved = path - rest[:, None]
    length = np.sqrt(np.mean(np.sum(moved**2, axis=-1)))
    return Tracks(rest, instants, moved * (0.5 / length))


def rigid(rng, points, times):
    """Blobs that swing about axes of their own and drift, each at its own pace."""
    rest, path = [], []
    for share in np.array_split(np.arange(points), BLOBS):
        center = rng.uniform(-0.7, 0.7, 3)
        local = rng.uniform(-0.3, 0.3, (len(share), 3))
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        angle = rng.uniform(0.8, 1.6) * np.sin(_phase(rng, times, 0.5, 2.0))
        turned = (
            local[:, None] * np.cos(angle)[:, None]
            + np.cross(axis, local)[:, None] * np.sin(angle)[:, None]
            + ((local @ axis)[:, None, None] * axis) * (1 - np.cos(angle))[:, None]
        )
        drift = rng.normal(0, 0.3, 3) * np.sin(_phase(rng, times, 0.5, 1.5))[:, None]
        rest.append(center + local)
        path.append(center + turned + drift)
    return np.concatenate(rest), np.concatenate(path)


def cloth(rng, points, times, waves=8):
    """A sheet with traveling waves of many lengths and paces, mostly across it."""
    rest = np.concatenate(
        [rng.uniform(-1, 1, (points, 2)), np.zeros((points, 1))], axis=1
    )
    path = np.repeat(rest[:, None], len(times), axis=1)
    for _ in range(waves):
        wave = rng.normal(0, 3.0, 2)
        pace = rng.uniform(0.5, 3.0) * 2 * np.pi
        phase = (rest[:, :2] @ wave)[:, None] - pace * times + rng.uniform(0, 6.3)
        direction = np.append(rng.normal(0, 0.3, 2), rng.normal())
        path += 0.2 * np.sin(phase)[..., None] * direction
    return rest, path


def wiggles(rng, points, times):
    """Every point on an ellipse of its own, unlike its neighbors'."""
    rest = rng.uniform(-1, 1, (points, 3))
    pace = 2 * np.pi * rng.uniform(0.5, 2.5, (points, 1))
    phase = pace * times + rng.uniform(0, 2 * np.pi, (points, 1))
    first, second = rng.normal(0, 0.2, (2, points, 1, 3))
    return rest, rest[:, None] + (
        first * np.cos(phase)[..., None] + second * np.sin(phase)[..., None]
    )


def mixed(rng, points, times):
    """A third of each of the above, side by side."""
    parts = [
        part(rng, len(share), times)
        for part, share in zip(
            (rigid, cloth, wiggles), np.array_split(np.arange(points), 3), strict=True
        )
    ]
    beside = np.array([-1.2, 0.0, 1.2])
    rest = [0.5 * own + [x, 0, 0] for (own, _), x in zip(parts, beside, strict=True)]
    path = [0.5 * own + [x, 0, 0] for (_, own), x in zip(parts, beside, strict=True)]
    rest, path = np.concatenate(rest), np.concatenate(path)
    reach = np.abs(rest).max()
    return rest / reach, path / reach


def scene(rng, points, times):
    """Points that the first camera sees on the built-in scene's bending things."""
    from nerfies_jax.capture import synthetic

    spec = dataclasses.replace(
        synthetic.PRESETS["non-rigid"],
        frames=len(times),
        size=(48, 36),
        tracks=points,
    )
    _, truth = synthetic.make(spec, int(rng.integers(2**31)))
    path = truth.track_world.astype(np.float64)
    middle = (path.min(axis=(0, 1)) + path.max(axis=(0, 1))) / 2
    path = (path - middle) / np.abs(path - middle).max()
    return path[:, 0], path


def _phase(rng, times, slowest, fastest):
    pace = 2 * np.pi * rng.uniform(slowest, fastest)
    return pace * times + rng.uniform(0, 2 * np.pi)


KINDS = {
    "rigid": rigid,
    "cloth": cloth,
    "wiggles": wiggles,
    "mixed": mixed,
    "scene": scene,
}
