"""Presets of synthetic scenes. Objects and cameras fit a box with unit diagonal."""

import dataclasses

from nerfies_jax.capture.synthetic.motion import Arm, Glide, Hinge, Path
from nerfies_jax.capture.synthetic.photographed import (
    COLLECTION,
    STATIC_20,
    STATIC_50,
)
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
from nerfies_jax.capture.synthetic.stage import (
    CUBE,
    FLOOR,
    FLOOR_Y,
    GLOBE,
    PLINTH,
    STAGE,
    WALL,
)
from nerfies_jax.capture.synthetic.texture import Texture

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
    "static-20": STATIC_20,
    "static-50": STATIC_50,
    "pan": PAN,
    "zoom": ZOOM,
}
