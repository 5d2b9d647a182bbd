"""Synthetic scenes of photographs: nothing moves, and the images have no order."""

import dataclasses

from nerfies_jax.capture.synthetic.shapes import Box, Sphere
from nerfies_jax.capture.synthetic.spec import (
    Collection,
    SceneSpec,
    Snapshots,
    Thing,
)
from nerfies_jax.capture.synthetic.stage import CUBE, FLOOR, FLOOR_Y, GLOBE, STAGE, WALL
from nerfies_jax.capture.synthetic.texture import Texture


def _stone(name, half, place, seed_size=0.03):
    """A part of the monument. `place` is the center of its base above the ground."""
    x, y, z = place
    texture = Texture(
        dark=(0.42, 0.36, 0.28),
        light=(0.90, 0.84, 0.72),
        blot=(0.55, 0.30, 0.22),
        checker=0.35,
        checker_size=seed_size,
        noise=0.6,
        noise_size=0.02,
        blots=0.5,
        blot_size=0.04,
    )
    return Thing(name, Box(half), (x, FLOOR_Y + y + half[1], z), texture)


def _bar(name, half, place):
    """A thin part of dark metal."""
    x, y, z = place
    metal = Texture(
        dark=(0.10, 0.12, 0.12), light=(0.25, 0.32, 0.30), blot=(0.45, 0.30, 0.15)
    )
    return Thing(name, Box(half), (x, FLOOR_Y + y + half[1], z), metal)


COLUMNS = (
    *((x, 0.06) for x in (-0.095, -0.032, 0.032, 0.095)),
    *((x, -0.06) for x in (-0.095, 0.095)),
)
# A small temple with columns, a globe on its roof, and a spire and a railing of 2 %
# of its size.
MONUMENT = (
    Thing(
        "square",
        Box((3.0, 0.02, 3.0)),
        (0.0, FLOOR_Y - 0.02, 0.0),
        dataclasses.replace(
            FLOOR.texture, checker=0.3, checker_size=0.12, noise_size=0.05
        ),
    ),
    _stone("base", (0.15, 0.012, 0.11), (0.0, 0.0, 0.0)),
    _stone("step", (0.125, 0.01, 0.09), (0.0, 0.024, 0.0), 0.02),
    *(
        _stone(f"column {index}", (0.011, 0.065, 0.011), (x, 0.044, z), 0.015)
        for index, (x, z) in enumerate(COLUMNS)
    ),
    _stone("roof", (0.12, 0.012, 0.085), (0.0, 0.174, 0.0), 0.02),
    dataclasses.replace(
        GLOBE, shape=Sphere(0.032), place=(0.0, FLOOR_Y + 0.198 + 0.032, 0.0)
    ),
    dataclasses.replace(
        CUBE, name="statue", place=(0.0, FLOOR_Y + 0.044 + 0.042, -0.01), motion=None
    ),
    _bar("spire", (0.003, 0.04, 0.003), (0.0, 0.26, 0.0)),
    _bar("rail", (0.15, 0.003, 0.003), (0.0, 0.045, 0.16)),
    *(
        _bar(f"post {index}", (0.003, 0.025, 0.003), (x, 0.0, 0.16))
        for index, x in enumerate((-0.147, -0.05, 0.05, 0.147))
    ),
)
COLLECTION = SceneSpec(
    "collection",
    MONUMENT,
    size=(128, 96),
    frames=100,
    heldout_every=8,
    points=2000,
    collection=Collection(),
)
# Seen from one side, with a thin fence in front of thicker things.
STILL_CUBE = dataclasses.replace(CUBE, name="still cube", motion=None)
STATIC_20 = SceneSpec(
    "static 20",
    (
        *STAGE,
        STILL_CUBE,
        _stone("pillar", (0.018, 0.11, 0.018), (0.15, 0.0, -0.1), 0.02),
        _bar("fence", (0.09, 0.003, 0.003), (0.1, 0.09, 0.02)),
        *(
            _bar(f"picket {index}", (0.003, 0.055, 0.003), (x, 0.0, 0.02))
            for index, x in enumerate((0.02, 0.06, 0.1, 0.14, 0.18))
        ),
    ),
    size=(240, 180),
    frames=20,
    heldout_every=8,
    snapshots=Snapshots(
        columns=5,
        rows=4,
        arc_rad=0.3,
        elevation_rad=(-0.05, 0.3),
        distance=(0.6, 0.72),
    ),
)
# The monument in a courtyard, seen from all around.
STATIC_50 = SceneSpec(
    "static 50",
    (
        *MONUMENT,
        *(
            dataclasses.replace(
                WALL, name=f"wall {name}", shape=Box(half), place=(x, 0.6, z)
            )
            for name, half, x, z in (
                ("north", (1.5, 0.8, 0.02), 0.0, -1.5),
                ("south", (1.5, 0.8, 0.02), 0.0, 1.5),
                ("west", (0.02, 0.8, 1.5), -1.5, 0.0),
                ("east", (0.02, 0.8, 1.5), 1.5, 0.0),
            )
        ),
    ),
    size=(240, 180),
    frames=50,
    heldout_every=8,
    snapshots=Snapshots(),
)
