"""Settings of a run: its capture, preset and steps.

This module does not import JAX, so that command lines parse quickly.
"""

import dataclasses
import math
import pathlib
from typing import Literal

from nerfies_jax.capture.external import ExternalFiles


class CaptureNotFound(ValueError):
    """The capture of a run is no longer at its path.

    Attributes:
      folder: Folder of the run.
    """

    def __init__(self, folder: pathlib.Path, capture: pathlib.Path | str):
        super().__init__(
            f"{folder}: its capture {capture} does not exist; if it was moved, pass "
            "its new path"
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
            f"preprocessing={preprocessing} must be a positive, finite multiple of the "
            "default budget"
        )


@dataclasses.dataclass(frozen=True)
class CaptureSource:
    """Images to read, from a folder or from a built-in scene."""

    capture: pathlib.Path | str | None = None  # converted to an absolute path
    """Folder in Nerfies, HyperNeRF, Blender, D-NeRF, COLMAP or LLFF layout."""
    scene: str = "default"
    """Built-in scene to use if no capture is given."""
    factor: int | None = None
    """Read images at 1/FACTOR of their size."""
    max_side: int | None = None
    """Longest side of the images in pixels. Larger images are read at lower
    resolution."""
    heldout: str | None = None
    """Frames to hold out: n for every n-th, or the name of a split."""
    missing: Literal["refuse", "skip"] = "refuse"
    """Handling of frames whose image is missing."""
    preprocessing: float | None = None
    """Work to spend on optical flow, tracks and masks, as a multiple of the default
    budget. Work beyond it is skipped (default: 1)."""
    files: ExternalFiles = ExternalFiles()
    """Results of other tools."""

    def __post_init__(self):
        check_budget(self.preprocessing)
        # Absolute, so that a run can be continued from any working directory.
        if self.capture is not None:
            folder = pathlib.Path(self.capture).absolute()
            object.__setattr__(self, "capture", folder)

    @property
    def arguments(self) -> tuple[str, ...]:
        """Command-line arguments that select these images, not quoted for a shell."""
        words = ["--scene", self.scene]
        if self.capture is not None:
            words = [str(self.capture)]
        fields = {**vars(self), **vars(self.files)}
        names = ("factor", "max_side", "heldout", "preprocessing", *vars(self.files))
        for name in names:
            value = fields[name]
            if value is not None:
                words += [f"--{name.replace('_', '-')}", str(value)]
        if self.missing != "refuse":
            words += ["--missing", self.missing]
        return tuple(words)


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """Settings that determine a run, stored in its `config.json`."""

    # None: chosen from the tracks of the capture. A stored run always has a preset.
    preset: str | None = None
    source: CaptureSource = CaptureSource()
    # None for the number of the preset. Schedules are rescaled to the number of steps.
    steps: int | None = None
    overrides: tuple[str, ...] = ()  # of fields of the preset, as PATH=VALUE
    seed: int = 0
    # Number of training frames that are left out, to keep the best state.
    validation: int = 0

    def __post_init__(self):
        if self.validation < 0:
            raise ValueError(
                f"validation={self.validation} must be a number of frames, at least 0"
            )

    @property
    def preset_name(self) -> str:
        """Name of the preset.

        Raises:
          ValueError: If none has been chosen yet.
        """
        if self.preset is None:
            raise ValueError(
                "preset=None: no preset has been chosen yet; set one, or let "
                "`adviser.by_tracks` choose it from the tracks of the capture"
            )
        return self.preset


@dataclasses.dataclass(frozen=True)
class Preparation:
    """Settings of the conversion of a video, or of images, to a capture."""

    frames: int | None = None
    """Number of frames of a video to keep, evenly spaced (default: 100)."""
    fps: float | None = None
    """Frames to keep per second of a video, instead of their total number."""
    max_side: int = 960
    """Longest side of the images in pixels."""
    masks: pathlib.Path | None = None
    """Masks in which moving objects are black: NAME.png for every image NAME, or one
    for every frame of a video, in order. Without masks, moving objects are detected."""
    passes: Literal[1, 2] = 2
    """2: estimate the cameras, detect moving objects, and estimate the cameras again
    with these masked. If the first pass registers too few images, moving objects are
    detected without cameras. 1: estimate the cameras once, without masks."""
    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"
    ] = "OPENCV"
    """COLMAP camera model to try first. If its result is implausible, simpler models
    are tried, and one whose focal length is held until all images are registered."""
    cameras: Literal["auto", "one", "each"] = "auto"
    """one: all images share one camera. each: every image has its own focal length.
    auto: one camera for each camera model and focal length in the headers of
    photographs, and one for each image if no shared camera succeeds."""
    piece: bool = False
    """If most images cannot be registered, use the largest piece of the video or set of
    images that can."""
    matcher: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Image pairs to match: neighboring images (sequential) or all (exhaustive). auto
    is sequential for more than 40 images."""
    threads: int | None = None
    """Number of cores (default: all)."""

    def __post_init__(self):
        if None not in (self.frames, self.fps):
            raise ValueError(
                f"frames={self.frames} and fps={self.fps} are mutually exclusive; set "
                "the number of frames of the video or the frames per second"
            )
        if self.frames is not None and self.frames < 3:
            raise ValueError(f"frames={self.frames} must be at least 3")
        if self.fps is not None and not 0 < self.fps < math.inf:
            raise ValueError(f"fps={self.fps} must be positive and finite")
        if self.max_side < 16:
            raise ValueError(f"max_side={self.max_side} must be at least 16 pixels")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads={self.threads} must be at least 1")


@dataclasses.dataclass(frozen=True)
class MoreMetrics:
    """Metrics of held-out frames that are computed only on request.

    LPIPS is also computed without a request if the extra `lpips` is installed.
    """

    lpips_weights: tuple[pathlib.Path | str, ...] = ()
    """Also compute LPIPS, with the weights of the network and of its linear heads in
    these files (.pth, .safetensors, .npz; default: those of the extra lpips, if it is
    installed)."""
    lpips_network: Literal["alex", "vgg"] = "alex"
    """Network of LPIPS, to which the weights belong."""
    fit_heldout_cameras: int = 0
    """Optimize the cameras of this many held-out frames with the trained scene fixed,
    and evaluate these frames again."""
    step_profile: bool = False
    """Measure the time of each part of a training step for the report. The parts are
    compiled separately, which takes longer than the measurement."""

    def __post_init__(self):
        if self.lpips_network not in ("alex", "vgg"):
            raise ValueError(
                f"lpips_network={self.lpips_network!r} must be 'alex' or 'vgg'"
            )
        if self.fit_heldout_cameras < 0:
            raise ValueError(
                f"fit_heldout_cameras={self.fit_heldout_cameras} must be a number of "
                "frames, at least 0"
            )
