"""Settings of a run: its capture, preset and steps. Imports no JAX."""

import dataclasses
import math
import pathlib
from typing import Literal

from nerfies_jax.capture.given import GivenFiles


class CaptureNotFound(ValueError):
    """The capture of a run is not where it was when the run was started.

    Attributes:
      folder: Folder of the run.
    """

    def __init__(self, folder: pathlib.Path, capture: pathlib.Path | str):
        super().__init__(
            f"{folder}: its capture {capture} is not there; if it was moved, name its "
            "new path"
        )
        self.folder = folder


def check_budget(preprocessing: float | None) -> None:
    """Check the budget of preprocessing.

    Args:
      preprocessing: Multiple of the default budget, or None.

    Raises:
      ValueError: If it is not positive and finite.
    """
    if preprocessing is not None and not 0 < preprocessing < math.inf:
        raise ValueError(
            f"preprocessing={preprocessing}: a positive multiple of the default budget"
        )


@dataclasses.dataclass(frozen=True)
class CaptureSource:
    """Images to read: those of a folder, or of a built-in scene."""

    capture: pathlib.Path | str | None = None  # a path, once it is made
    """Folder in Nerfies, HyperNeRF, Blender, D-NeRF, COLMAP or LLFF layout."""
    scene: str = "default"
    """Built-in scene to use if no capture is given."""
    factor: int | None = None
    """Read images at 1/FACTOR of their size."""
    max_side: int | None = None
    """Read images with no side longer than this, in pixels."""
    heldout: str | None = None
    """Frames to hold out: n for every n-th, or the name of a split."""
    missing: Literal["refuse", "skip"] = "refuse"
    """Handling of frames whose image is missing."""
    preprocessing: float | None = None
    """Work to spend on optical flow, tracks and masks, as a multiple of the default
    budget. Work beyond it is skipped (default: 1)."""
    files: GivenFiles = GivenFiles()
    """Results of other tools."""

    def __post_init__(self):
        check_budget(self.preprocessing)
        if self.capture is not None:  # one folder has one name, wherever it is opened
            folder = pathlib.Path(self.capture).absolute()
            object.__setattr__(self, "capture", folder)

    @property
    def arguments(self) -> tuple[str, ...]:
        """Arguments of a command line that name these images, not quoted."""
        words = ["--scene", self.scene]
        if self.capture is not None:
            words = [str(self.capture)]
        fields = {**vars(self), **vars(self.files)}
        own = ("factor", "max_side", "heldout", "preprocessing")
        for name in (*own, *vars(self.files)):
            value = fields[name]
            if value is not None:
                words += [f"--{name.replace('_', '-')}", str(value)]
        if self.missing != "refuse":
            words += ["--missing", self.missing]
        return tuple(words)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Settings that determine a run, kept in its `config.json`."""

    # None: what the capture calls for, by its tracks; a saved run names it.
    preset: str | None = None
    source: CaptureSource = CaptureSource()
    steps: int | None = None  # the preset's own; schedules stretch with them
    overrides: tuple[str, ...] = ()  # of the preset's fields, as PATH=VALUE
    seed: int = 0

    @property
    def preset_name(self) -> str:
        """Name of the preset.

        Raises:
          ValueError: If none is chosen yet.
        """
        if self.preset is None:
            raise ValueError(
                "these settings name no preset yet; choose one, or let "
                "`adviser.by_tracks` choose it by the tracks of the capture"
            )
        return self.preset


@dataclasses.dataclass(frozen=True)
class Preparation:
    """Settings of the conversion of a video or of plain images to a capture."""

    frames: int | None = None
    """Frames of a video to keep, evenly spaced (default: 100)."""
    fps: float | None = None
    """Frames to keep per second of a video, instead of a number."""
    max_side: int = 960
    """Longest side of the images in pixels."""
    masks: pathlib.Path | None = None
    """Masks of moving objects, which are black: NAME.png for every image NAME, or one
    for every frame of a video, in order. Without them moving objects are detected."""
    passes: Literal[1, 2] = 2
    """2: detect moving objects with the first cameras, and estimate the cameras again
    without them, or detect them without cameras if too few images are registered. 1:
    use the first cameras."""
    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"
    ] = "OPENCV"
    """COLMAP's name of the lens model, the same for all images."""
    matcher: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Image pairs to match: neighbors, or all (auto: neighbors of more than 40
    images)."""
    threads: int | None = None
    """Number of cores (default: all)."""

    def __post_init__(self):
        if None not in (self.frames, self.fps):
            raise ValueError(
                f"frames={self.frames} and fps={self.fps}: give the frames of a film "
                "or so many a second, not both"
            )
        if self.frames is not None and self.frames < 3:
            raise ValueError(f"frames={self.frames}: keep at least 3")
        if self.fps is not None and not 0 < self.fps < math.inf:
            raise ValueError(f"fps={self.fps}: a positive number of frames a second")
        if self.max_side < 16:
            raise ValueError(f"max_side={self.max_side}: expected at least 16 pixels")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads={self.threads}: use at least 1")


@dataclasses.dataclass(frozen=True)
class MoreMetrics:
    """Metrics of held-out frames that are computed only on request."""

    lpips_weights: tuple[pathlib.Path | str, ...] = ()
    """Also measure LPIPS: files (.pth, .safetensors, .npz) with the trained classifier
    and the LPIPS heads."""
    lpips_network: Literal["alex", "vgg"] = "alex"
    """Whose weights these are."""
    fit_heldout_cameras: int = 0
    """Fit the cameras of this many held-out frames to their images, with the trained
    scene fixed, and evaluate them again."""

    def __post_init__(self):
        if self.lpips_network not in ("alex", "vgg"):
            raise ValueError(
                f"lpips_network={self.lpips_network!r}: there are alex and vgg"
            )
        if self.fit_heldout_cameras < 0:
            raise ValueError(
                f"fit_heldout_cameras={self.fit_heldout_cameras}: a number of frames, "
                "not negative"
            )
