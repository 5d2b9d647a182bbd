"""Settings of a synthetic scene: objects, cameras and effects. Frozen and hashable."""

import dataclasses
import math
from typing import Literal

from nerfies_jax.capture.synthetic.motion import Motion, Vector, unit_axis
from nerfies_jax.capture.synthetic.shapes import Shape
from nerfies_jax.capture.synthetic.texture import Texture
from nerfies_jax.geometry.lens import COEFFICIENTS


@dataclasses.dataclass(frozen=True)
class Thing:
    """One object: its shape, texture, initial position and motion."""

    name: str
    shape: Shape
    place: Vector  # world position of the body's origin without motion
    texture: Texture = Texture()
    motion: Motion | None = None  # None for a static position

    def moves(self) -> bool:
        """Return whether any point of the object ever moves.

        Returns:
          True for an object with a motion or a deformation.
        """
        return self.motion is not None or self.shape.bends()


@dataclasses.dataclass(frozen=True)
class Cameras:
    """A hand-held camera that moves along an arc, and a second camera next to it.

    The first camera sweeps back and forth around the target and moves closer, with
    smooth shake. Its period differs from those of the objects, since a single camera
    cannot determine the depth of an object that moves in phase with it. The second
    camera looks at the same target, and its images are never used for training.
    """

    distance: float = 0.66  # largest distance from the target, scene units
    target: Vector = (0.0, -0.02, 0.0)
    height: float = 0.07  # above the target, scene units
    arc_rad: float = 0.38  # to either side
    sweeps: float = 2.5  # periods per capture
    forward: float = 0.05  # amplitude of the movement toward the target, scene units
    shake: float = 0.005  # root mean square of position and target, scene units
    field_of_view_rad: float = 0.85  # horizontal
    # Offset of the second camera to the right, up and back, scene units.
    beside: Vector = (0.09, 0.05, 0.0)
    # The next two are not in `repr`, which identifies cached scenes, so that scenes
    # without them keep their identity.
    # Largest rotation of the view to either side of the target, about the vertical.
    pan_rad: float = dataclasses.field(default=0.0, repr=False)
    # Ratio of the longest focal length, in the middle of the capture, to the shortest.
    zoom: float = dataclasses.field(default=1.0, repr=False)

    def __post_init__(self):
        if not abs(self.pan_rad) < 1.5:
            raise ValueError(f"pan_rad={self.pan_rad} must lie between -1.5 and 1.5")
        if not 0 < self.zoom < 100:
            raise ValueError(f"zoom={self.zoom} must be positive and below 100")
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
            raise ValueError(f"shake={self.shake} must not be negative; 0 is steady")


@dataclasses.dataclass(frozen=True)
class Rig:
    """Static cameras on an arc in two rows that take turns, in place of the first one.

    Frame n is observed by camera n up to the last one, and then backward. The distance,
    target and height are those of `Cameras`, without its movement and shake.
    """

    count: int = 12
    step_rad: float = 0.15  # between neighboring cameras, as seen from the target
    rise: float = 0.05  # of every second camera above the others, scene units

    def __post_init__(self):
        if self.count < 2:
            raise ValueError(f"count={self.count}: a rig needs at least two cameras")
        span = self.step_rad * (self.count - 1)
        if not 0 < span < 3:
            raise ValueError(
                f"step_rad={self.step_rad} for count={self.count} cameras makes an arc "
                f"of {span:.2f} rad, which must lie between 0 and 3"
            )

    def angles(self, frames: int) -> list[float]:
        """Return the angle of the camera of each frame on the arc.

        Args:
          frames: Number of frames.

        Returns:
          Angles in rad, zero in the middle of the arc.
        """
        return [
            (camera - (self.count - 1) / 2) * self.step_rad
            for camera in self.turns(frames)
        ]

    def turns(self, frames: int) -> list[int]:
        """Return the index of the camera that observes each frame.

        Args:
          frames: Number of frames.

        Returns:
          Indices along the arc.
        """
        last = self.count - 1
        return [last - abs(last - frame % (2 * last)) for frame in range(frames)]


@dataclasses.dataclass(frozen=True)
class Lens:
    """Lens distortion of both cameras."""

    model: Literal["pinhole", "fisheye"] = "pinhole"
    # In OpenCV's order: k1 k2 p1 p2 [k3], of a fisheye k1 k2 k3 k4.
    coefficients: tuple[float, ...] = (-0.3, 0.0, 0.0, 0.0)

    def __post_init__(self):
        counts = COEFFICIENTS.get(self.model)
        if counts is None or len(self.coefficients) not in counts:
            raise ValueError(
                f"a lens of model {self.model!r} with {len(self.coefficients)} "
                f"coefficients; expected numbers of coefficients: {COEFFICIENTS}"
            )


@dataclasses.dataclass(frozen=True)
class Exposure:
    """Exposure and white balance that drift smoothly over time, in linear light."""

    stops: float = 0.5  # root mean square; one stop doubles the light
    tint: float = 0.06  # root mean square share, for red and blue


@dataclasses.dataclass(frozen=True)
class PoseError:
    """Pose error of the first camera's frames, independent for each frame.

    It simulates errors of structure from motion. The second camera, which is used for
    evaluation, has its true pose.
    """

    turn_px: float = 0.6  # root mean square of the rotation about each axis
    shift_px: float = 0.6  # of the translation along each axis, at the target distance

    def __post_init__(self):
        if not (self.turn_px >= 0 and self.shift_px >= 0):
            raise ValueError(
                f"turn_px={self.turn_px} and shift_px={self.shift_px} must not be "
                "negative; 0 is exact"
            )


@dataclasses.dataclass(frozen=True)
class Transient:
    """An object that passes in front of the first camera and is not part of the scene.

    It is absent from the second camera's frames, which evaluate the scene without it.
    """

    thing: Thing
    windows: tuple[tuple[float, float], ...]  # (start, stop) times of its presence

    def __post_init__(self):
        for start, stop in self.windows:
            if not 0 <= start < stop <= 1:
                raise ValueError(
                    f"window ({start}, {stop}) must satisfy 0 <= start < stop <= 1; "
                    "times run from 0 to 1 over the capture"
                )


@dataclasses.dataclass(frozen=True)
class Specular:
    """A specular highlight, which depends on the viewpoint (Blinn 1977)."""

    thing: str  # name of the specular object
    strength: float = 0.5  # added to all channels, linear light
    sharpness: float = 40.0  # exponent of the half-angle cosine


@dataclasses.dataclass(frozen=True)
class Collection:
    """Photographs of a static object by many people, as on the internet.

    Each photograph has its own camera, focal length, exposure, white balance, tone
    curve and sky, and some show a board in front of the object. They replace the
    hand-held camera, and `SceneSpec.frames` is their number. Views for evaluation show
    no boards and have the appearance of one of the photographs.
    """

    object_size: float = 0.3  # scene units
    target: Vector = (0.0, -0.03, 0.0)
    distance: tuple[float, float] = (2.0, 8.0)  # from the target, in object sizes
    arc_rad: float = 1.2  # to either side
    elevation_rad: tuple[float, float] = (0.02, 0.3)
    fill: tuple[float, float] = (0.5, 0.95)  # share of the width that the object fills
    focal_widths: tuple[float, float] = (0.7, 5.0)  # bounds, in image widths
    stops: float = 1.5  # largest deviation of the exposure
    tint_stops: float = 0.35  # largest deviation of red and blue
    tone: float = 0.25  # strength of the tone curves
    boards: float = 1 / 3  # share of the photographs
    masked: bool = False  # True for masks without skies and boards

    def __post_init__(self):
        if not (self.object_size > 0 and 0 < self.distance[0] <= self.distance[1]):
            raise ValueError(
                f"object_size={self.object_size} and distance={self.distance} must be "
                "positive, and distance must not decrease"
            )
        if not 0 <= self.boards <= 1:
            raise ValueError(f"boards={self.boards} must lie in [0, 1]")


@dataclasses.dataclass(frozen=True)
class Snapshots:
    """Photographs of a static scene with one camera, in no order of place or time.

    They replace the hand-held camera and the second one. There is one viewpoint in each
    cell of a grid over azimuth and elevation, at a random place in it and at a random
    distance. `SceneSpec.frames` is their number, and every `heldout_every`-th one, from
    the first on, is held out, as in LLFF.
    """

    columns: int = 10  # of the grid, over the azimuth
    rows: int = 5  # of the grid, over the elevation
    target: Vector = (0.0, -0.03, 0.0)
    arc_rad: float = math.pi  # to either side
    elevation_rad: tuple[float, float] = (0.05, 0.75)
    distance: tuple[float, float] = (0.5, 1.1)  # from the target, scene units
    field_of_view_rad: float = 0.85  # horizontal
    aim: float = 0.03  # largest deviation of the aim along each axis, scene units

    def __post_init__(self):
        if self.columns < 1 or self.rows < 1:
            raise ValueError(
                f"columns={self.columns} and rows={self.rows} must be at least 1"
            )
        if not 0 < self.distance[0] <= self.distance[1]:
            raise ValueError(
                f"distance={self.distance} must be positive and must not decrease"
            )
        if not 0 < self.field_of_view_rad < 3:
            raise ValueError(
                f"field_of_view_rad={self.field_of_view_rad} must lie between 0 and 3"
            )


@dataclasses.dataclass(frozen=True)
class SceneSpec:
    """An analytic dynamic scene and its cameras. An effect of None is absent."""

    name: str
    things: tuple[Thing, ...]
    cameras: Cameras = Cameras()
    size: tuple[int, int] = (176, 132)  # width, height in pixels
    frames: int = 60  # timestamps, all observed by the first camera
    heldout_every: int = 4  # the second camera observes every n-th timestamp
    skip_every: int | None = None  # every n-th frame of the first camera is held out
    supersampling: int = 2  # n x n rays per pixel for color
    points: int = 2500  # static surface points, as from structure from motion
    point_noise: float = 0.0005  # root mean square of each coordinate, scene units
    tracks: int = 384  # true tracks of moving surface points
    light: Vector = (0.45, 0.75, 0.6)  # toward the light
    ambient: float = 0.45  # share of ambient light
    background: Vector = (0.5, 0.6, 0.7)  # sRGB, behind everything
    exposure: Exposure | None = None
    transient: Transient | None = None
    specular: Specular | None = None
    # Not in `repr`, which identifies cached scenes, so that scenes without it keep
    # their identity.
    pose_error: PoseError | None = dataclasses.field(default=None, repr=False)
    lens: Lens | None = dataclasses.field(default=None, repr=False)
    # The first camera's frames are then those of the rig.
    rig: Rig | None = dataclasses.field(default=None, repr=False)
    collection: Collection | None = dataclasses.field(default=None, repr=False)
    snapshots: Snapshots | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self):
        unit_axis(self.light)
        self._check_counts()
        names = [thing.name for thing in self.all_things()]
        duplicate = next((name for name in names if names.count(name) > 1), None)
        if duplicate is not None:
            raise ValueError(f"two things are called {duplicate!r}; rename one")
        if self.specular is not None and self.specular.thing not in names:
            raise ValueError(
                f"specular thing {self.specular.thing!r} is not in the scene; "
                f"choose one of {', '.join(names)}"
            )
        if self.photographed:
            self._check_photographs()

    @property
    def photographed(self) -> bool:
        """True if the images are photographs without order, and not a video."""
        return self.collection is not None or self.snapshots is not None

    def _check_photographs(self):
        others = ["exposure", "transient", "pose_error", "lens", "rig"]
        if self.snapshots is not None:
            others = ["transient", "rig", "collection"]
        present = [name for name in others if getattr(self, name) is not None]
        moving = [thing.name for thing in self.things if thing.moves()]
        if present or moving:
            raise ValueError(
                "photographs show static objects and have their own cameras and "
                f"appearances; remove {', '.join(present + moving)}"
            )
        grid = self.snapshots
        if grid is not None and self.frames != grid.columns * grid.rows:
            raise ValueError(
                f"frames={self.frames} must be {grid.columns} columns times "
                f"{grid.rows} rows of snapshots, {grid.columns * grid.rows}"
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
                f"skip_every={self.skip_every} leaves no training frames; use at least "
                "2"
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
        """Id of the transient object or of boards, or -2, which no pixel has."""
        has_transient = self.transient is not None or self.collection is not None
        return len(self.things) if has_transient else -2
