"""Objects that several synthetic scenes share."""

from nerfies_jax.capture.synthetic.motion import Path
from nerfies_jax.capture.synthetic.shapes import Box, Sphere
from nerfies_jax.capture.synthetic.spec import Thing
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
STAGE = (WALL, FLOOR, PLINTH, GLOBE)
