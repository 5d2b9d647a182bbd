"""Presets of synthetic scenes. Objects and cameras fit a box with unit diagonal."""

import dataclasses

from nerfies_jax.capture.synthetic.motion import Arm, Glide, Hinge, Path
from nerfies_jax.capture.synthetic.shapes import Box, Sheet, Sphere, Squash
from nerfies_jax.capture.synthetic.spec import (
    Cameras,
    Collection,
    Exposure,
    Lens,
    PoseError,
    Rig,
    SceneSpec,
    Specular,
    Thing,
    Transient,
)
from nerfies_jax.capture.synthetic.texture import Texture

FLOOR_Y = -0.17

WALL = Thing(
    "wall",
    Box((1.2, 0.7, 0.02)),
    (0.0, 0.3, -0.3),
    Texture(
        dark=(0.36, 0.42, 0.50),
        light=(0.82, 0.80, 0.72),
        blot=(0.55, 0.36, 0.34),
        checker=0.25,
        checker_size=0.09,
        stripes=0.3,
        stripes_per_unit=(14.0, 6.0, 0.0),
        noise=0.7,
        noise_size=0.05,
        blots=0.7,
        blot_size=0.1,
    ),
)
FLOOR = Thing(
    "floor",
    Box((1.2, 0.02, 0.9)),
    (0.0, FLOOR_Y - 0.02, 0.4),
    Texture(
        dark=(0.30, 0.22, 0.17),
        light=(0.86, 0.74, 0.56),
        blot=(0.45, 0.42, 0.30),
        checker=0.8,
        checker_size=0.07,
        noise=0.5,
        noise_size=0.03,
        blots=0.4,
        blot_size=0.12,
    ),
)
PLINTH = Thing(
    "plinth",
    Box((0.05, 0.07, 0.05)),
    (-0.2, FLOOR_Y + 0.07, -0.12),
    Texture(
        dark=(0.20, 0.33, 0.36),
        light=(0.70, 0.82, 0.76),
        blot=(0.88, 0.72, 0.32),
        checker=0.0,
        stripes=0.6,
        stripes_per_unit=(0.0, 45.0, 12.0),
        noise=0.5,
        noise_size=0.02,
        blots=0.5,
        blot_size=0.03,
    ),
)
GLOBE = Thing(
    "globe",
    Sphere(0.055),
    (-0.2, FLOOR_Y + 0.195, -0.12),
    Texture(
        dark=(0.10, 0.28, 0.52),
        light=(0.35, 0.62, 0.80),
        blot=(0.72, 0.74, 0.36),
        checker=0.0,
        noise=0.9,
        noise_size=0.04,
        blots=1.0,
        blot_size=0.035,
    ),
)
CLOTH = Thing(
    "cloth",
    Sheet(half_width=0.095, half_height=0.105),
    (0.15, 0.045, -0.07),
    Texture(
        dark=(0.62, 0.10, 0.14),
        light=(0.96, 0.88, 0.74),
        blot=(0.14, 0.20, 0.42),
        checker=1.0,
        checker_size=0.038,
        noise=0.35,
        noise_size=0.02,
        blots=0.8,
        blot_size=0.045,
    ),
)
CUBE = Thing(
    "cube",
    Box((0.042, 0.042, 0.042)),
    (-0.02, -0.06, 0.08),
    Texture(
        dark=(0.12, 0.38, 0.22),
        light=(0.95, 0.80, 0.25),
        blot=(0.80, 0.30, 0.12),
        checker=1.0,
        checker_size=0.021,
        noise=0.3,
        noise_size=0.015,
        blots=0.4,
        blot_size=0.03,
    ),
    Path(
        sway=(0.045, 0.02, 0.02),
        cycles=(1.0, 1.0, 1.0),
        phase=(0.0, 0.25, 0.25),
        axis=(0.3, 1.0, 0.2),
        turns=0.2,
    ),
)
# It moves by twice its width to either side and rotates by three quarters of a turn. A
# short optimization averages this motion away.
FAST_CUBE = dataclasses.replace(
    CUBE,
    name="fast cube",
    motion=Path(
        sway=(0.1, 0.03, 0.05),
        cycles=(1.0, 2.0, 1.0),
        phase=(0.0, 0.0, 0.25),
        axis=(0.3, 1.0, 0.2),
        turns=0.75,
    ),
)
BALL = Thing(
    "ball",
    Sphere(0.055, Squash(amount=0.3, cycles=2.0)),
    (0.02, FLOOR_Y + 0.055 + 0.06, 0.06),
    dataclasses.replace(CUBE.texture, dark=(0.45, 0.10, 0.35), checker_size=0.03),
    Path(sway=(0.06, 0.06, 0.0), cycles=(1.0, 2.0, 1.0)),
)
_SHOULDER = Hinge((0.09, 0.13, -0.02), swing_rad=0.6)
_ELBOW = Hinge(
    (0.09, 0.0, -0.02), axis=(0.2, 0.0, 1.0), rest_rad=-0.3, swing_rad=0.8, phase=0.2
)
UPPER_ARM = Thing(
    "upper arm",
    Box((0.022, 0.065, 0.022)),
    (0.09, 0.065, -0.02),
    PLINTH.texture,
    Arm((_SHOULDER,)),
)
FOREARM = Thing(
    "forearm",
    Box((0.02, 0.055, 0.02)),
    (0.09, -0.055, -0.02),
    CUBE.texture,
    Arm((_SHOULDER, _ELBOW)),
)
# Two lumps that move through each other. They overlap for two fifths of the time, when
# the parts of each inside the other are not surfaces.
_APART = Path(sway=(0.035, 0.0, 0.0), cycles=(2.0, 1.0, 1.0))
LEFT_LUMP = Thing(
    "left lump", Sphere(0.045), (-0.07, -0.05, 0.08), CUBE.texture, _APART
)
RIGHT_LUMP = Thing(
    "right lump",
    Sphere(0.04),
    (0.03, -0.05, 0.08),
    BALL.texture,
    dataclasses.replace(_APART, sway=(-0.035, 0.0, 0.0)),
)
# Two halves of a shutter, which is closed at times 0, 1/2 and 1, when gap and inner
# faces are not observable. In between it opens by 0.08 and reveals the wall.
_SLIDE = Path(sway=(0.02, 0.0, 0.0), cycles=(2.0, 1.0, 1.0), phase=(-0.25, 0.0, 0.0))
LEFT_SHUTTER = Thing(
    "left shutter",
    Box((0.04, 0.09, 0.015)),
    (0.09, 0.03, -0.07),
    CLOTH.texture,
    dataclasses.replace(_SLIDE, sway=(-0.02, 0.0, 0.0)),
)
RIGHT_SHUTTER = Thing(
    "right shutter",
    Box((0.04, 0.09, 0.015)),
    (0.21, 0.03, -0.07),
    CLOTH.texture,
    _SLIDE,
)
PASSER = Thing(
    "passer",
    Box((0.035, 0.25, 0.02)),
    (-0.3, 0.0, 0.3),
    Texture(dark=(0.1, 0.1, 0.14), light=(0.3, 0.3, 0.36), blot=(0.5, 0.2, 0.2)),
    Glide((0.6, 0.0, 0.0)),
)
STAGE = (WALL, FLOOR, PLINTH, GLOBE)

DEFAULT = SceneSpec("cloth and cube", (*STAGE, CLOTH, CUBE))
STATIC = SceneSpec(
    "still life", (*STAGE, dataclasses.replace(CUBE, name="still cube", motion=None))
)
RIGID = SceneSpec("cube", (*STAGE, CUBE))
FAST = SceneSpec("fast cube", (*STAGE, CLOTH, FAST_CUBE))
NON_RIGID = SceneSpec("cloth and ball", (*STAGE, CLOTH, BALL))
ARTICULATED = SceneSpec("arm", (*STAGE, UPPER_ARM, FOREARM))
EXPOSED = dataclasses.replace(DEFAULT, name="exposure", exposure=Exposure())
PASSED = dataclasses.replace(
    DEFAULT,
    name="transient",
    transient=Transient(PASSER, ((0.1, 0.25), (0.45, 0.6), (0.75, 0.9))),
)
SHINY = dataclasses.replace(
    STATIC, name="specular", specular=Specular("globe", strength=0.8, sharpness=20.0)
)
MISPLACED = dataclasses.replace(DEFAULT, name="pose error", pose_error=PoseError())
TOPOLOGY = SceneSpec(
    "lumps and shutter", (*STAGE, LEFT_LUMP, RIGHT_LUMP, LEFT_SHUTTER, RIGHT_SHUTTER)
)
BARREL = dataclasses.replace(DEFAULT, name="barrel lens", lens=Lens())
# 61 degrees off the axis in the corners.
FISHEYE = dataclasses.replace(
    DEFAULT,
    name="fisheye",
    cameras=Cameras(field_of_view_rad=1.4),
    lens=Lens("fisheye", (-0.02, 0.01, -0.003, 0.0005)),
)
# The view turns by 40 degrees to either side of the moving objects, while the camera
# itself moves by a tenth of their distance only.
PAN = dataclasses.replace(
    DEFAULT,
    name="pan",
    cameras=Cameras(arc_rad=0.06, forward=0.03, sweeps=1.25, pan_rad=0.7),
    size=(320, 240),
)
ZOOM = dataclasses.replace(
    DEFAULT, name="zoom", cameras=Cameras(sweeps=1.25, zoom=1.6), size=(320, 240)
)
# Between neighboring frames, whose views differ by 9 degrees, it rotates by 24 degrees
# and moves by a tenth of the image width. Dense flow fails on it in a third of them.
BALLOON = Thing(
    "balloon",
    Sphere(0.085),
    (0.0, 0.0, 0.05),
    Texture(
        dark=(0.10, 0.22, 0.55),
        light=(0.95, 0.85, 0.35),
        blot=(0.85, 0.20, 0.18),
        checker=0.0,
        noise=1.0,
        noise_size=0.02,
        blots=1.0,
        blot_size=0.035,
    ),
    Path(
        sway=(0.12, 0.04, 0.05),
        cycles=(2.0, 3.0, 2.0),
        axis=(0.2, 1.0, 0.1),
        turns=1.5,
    ),
)
RIG = SceneSpec(
    "rig",
    (
        dataclasses.replace(WALL, shape=Box((2.4, 0.7, 0.02))),
        dataclasses.replace(FLOOR, shape=Box((2.4, 0.02, 0.9))),
        PLINTH,
        GLOBE,
        BALLOON,
    ),
    frames=24,
    heldout_every=2,
    rig=Rig(),
)


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

PRESETS = {
    "default": DEFAULT,
    "static": STATIC,
    "rigid": RIGID,
    "fast": FAST,
    "non-rigid": NON_RIGID,
    "articulated": ARTICULATED,
    "exposure": EXPOSED,
    "transient": PASSED,
    "specular": SHINY,
    "topology": TOPOLOGY,
    "pose-error": MISPLACED,
    "barrel": BARREL,
    "fisheye": FISHEYE,
    "rig": RIG,
    "collection": COLLECTION,
    "collection-masked": dataclasses.replace(
        COLLECTION, collection=Collection(masked=True)
    ),
    "pan": PAN,
    "zoom": ZOOM,
}
