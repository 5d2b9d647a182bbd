"""Settings of a synthetic scene: objects, cameras and effects. Frozen and hashable."""

import dataclasses

from nerfies_jax.capture.synthetic.motion import Motion, Vector, unit_axis
from nerfies_jax.capture.synthetic.shapes import Shape
from nerfies_jax.capture.synthetic.texture import Texture


@dataclasses.dataclass(frozen=True)
class Thing:
    """One object: its shape, texture, rest position and motion."""

    name: str
    shape: Shape
    place: Vector  # of the body's origin at rest, world
    texture: Texture = Texture()
    motion: Motion | None = None  # None stays in its place

    def moves(self) -> bool:
        """Return whether any point of the object ever moves.

        Returns:
          True for an object with a motion or a deformation.
        """
        return self.motion is not None or self.shape.bends()


@dataclasses.dataclass(frozen=True)
class Cameras:
    """A casual hand-held arc, and a second camera next to the first.

    The hand sweeps to and fro about the target and leans forward, with smooth shake.
    Its period differs from those of the objects, since one camera cannot tell the depth
    of an object that swings in step with it. The second camera looks at the same
    target, and its images are never used for training.
    """

    distance: float = 0.66  # from the target at rest, scene units
    target: Vector = (0.0, -0.02, 0.0)
    height: float = 0.07  # above the target
    arc_rad: float = 0.38  # to either side
    sweeps: float = 2.5  # to and fro, per capture
    forward: float = 0.05  # how far the hand comes closer, scene units
    shake: float = 0.005  # root mean square, of position and of aim, scene units
    field_of_view_rad: float = 0.85  # across the width
    beside: Vector = (0.09, 0.05, 0.0)  # second camera: right, up, back; scene units

    def __post_init__(self):
        if not self.distance - self.forward > 0:
            raise ValueError(
                f"forward={self.forward} must stay below distance={self.distance}, or "
                "the camera reaches its target"
            )
        if not 0 < self.field_of_view_rad < 3:
            raise ValueError(
                f"field_of_view_rad={self.field_of_view_rad} must lie between 0 and 3"
            )
        if self.shake < 0:
            raise ValueError(f"shake={self.shake} must not be negative; 0 holds still")


@dataclasses.dataclass(frozen=True)
class Exposure:
    """Brightness and tint that drift from instant to instant, in linear light."""

    stops: float = 0.5  # root mean square; one stop doubles the light
    tint: float = 0.06  # root mean square share, for red and blue


@dataclasses.dataclass(frozen=True)
class PoseError:
    """Pose error of the first camera's frames, independent for each frame.

    It stands for errors of structure from motion. The second camera, which is for
    evaluation, has its true pose.
    """

    turn_px: float = 0.6  # root mean square about each axis, seen in the picture
    shift_px: float = 0.6  # along each axis, of what is as far as the target

    def __post_init__(self):
        if not (self.turn_px >= 0 and self.shift_px >= 0):
            raise ValueError(
                f"turn_px={self.turn_px} and shift_px={self.shift_px} must not be "
                "negative; 0 is exact"
            )


@dataclasses.dataclass(frozen=True)
class Transient:
    """An object that passes in front of the first camera and is not in the scene.

    It is in none of the second camera's frames, which evaluate the scene without it.
    """

    thing: Thing
    windows: tuple[tuple[float, float], ...]  # when it is there: (start, stop) times

    def __post_init__(self):
        for start, stop in self.windows:
            if not 0 <= start < stop <= 1:
                raise ValueError(
                    f"window ({start}, {stop}) must satisfy 0 <= start < stop <= 1; "
                    "times run from 0 to 1 over the capture"
                )


@dataclasses.dataclass(frozen=True)
class Specular:
    """A polished surface: a highlight that moves with the eye (Blinn 1977)."""

    thing: str  # name of the thing that shines
    strength: float = 0.5  # added to all channels, linear light
    sharpness: float = 40.0  # exponent of the half-angle cosine


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """An analytic dynamic scene and its recording. An effect of None is absent."""

    name: str
    things: tuple[Thing, ...]
    cameras: Cameras = Cameras()
    size: tuple[int, int] = (176, 132)  # width, height in pixels
    frames: int = 60  # instants over the capture, all seen by the first camera
    heldout_every: int = 4  # the second camera looks at every so-manieth instant
    skip_every: int | None = None  # the first camera's frames kept from training, too
    supersampling: int = 2  # n x n rays for each pixel's color
    points: int = 2500  # static surface points, as from structure from motion
    point_noise: float = 0.0005  # root mean square of each coordinate, scene units
    tracks: int = 384  # true tracks of moving surface points
    light: Vector = (0.45, 0.75, 0.6)  # toward the light
    ambient: float = 0.45  # share of the light that comes from everywhere
    background: Vector = (0.5, 0.6, 0.7)  # sRGB, behind everything
    exposure: Exposure | None = None
    transient: Transient | None = None
    specular: Specular | None = None
    # Not in the representation, which names films: those without are as they were.
    pose_error: PoseError | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self):
        unit_axis(self.light)
        self._check_counts()
        names = [thing.name for thing in self.all_things()]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two things are called {twice!r}; rename one")
        if self.specular is not None and self.specular.thing not in names:
            raise ValueError(
                f"specular thing {self.specular.thing!r} is not in the scene; "
                f"choose one of {', '.join(names)}"
            )

    def _check_counts(self):
        least = {
            "frames": 2,
            "heldout_every": 1,
            "supersampling": 1,
            "points": 0,
            "tracks": 0,
        }
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(
                    f"{name}={getattr(self, name)} must be at least {bound}"
                )
        if self.skip_every is not None and self.skip_every < 2:
            raise ValueError(
                f"skip_every={self.skip_every} leaves nothing to learn from; at least 2"
            )
        if min(self.size) < 8:
            raise ValueError(f"size={self.size} must be at least 8x8 pixels")
        if not self.things:
            raise ValueError("a scene needs at least one thing")
        if not 0 <= self.ambient <= 1:
            raise ValueError(f"ambient={self.ambient} must lie in [0, 1]")

    def all_things(self) -> tuple[Thing, ...]:
        """Return the objects in the order of their ids, with the transient last.

        Returns:
          The objects.
        """
        if self.transient is None:
            return self.things
        return (*self.things, self.transient.thing)

    def id_of(self, name: str) -> int:
        """Return the id of an object, as in `SceneTruth.things`.

        Args:
          name: Name of the object.

        Returns:
          The id.

        Raises:
          ValueError: If there is no such object.
        """
        names = [thing.name for thing in self.all_things()]
        if name not in names:
            raise ValueError(f"no thing {name!r}; there are {', '.join(names)}")
        return names.index(name)

    @property
    def transient_id(self) -> int:
        """Id of the transient, or -2, which no pixel has, if there is none."""
        return -2 if self.transient is None else len(self.things)
