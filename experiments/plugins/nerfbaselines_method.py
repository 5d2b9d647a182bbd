"""The method `nerfies-jax` of nerfbaselines: static presets of both packages."""

import collections
import json
import math
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from experiments.plugins import nerfbaselines_capture as conversion
from gaussians_jax.core import splats
from gaussians_jax.io import single_time
from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation import Renderer, frames_of
from nerfies_jax.geometry import camera
from nerfies_jax.runs import run
from nerfies_jax.runs.config import RunConfig
from nerfies_jax.runs.representations import of_preset
from nerfies_jax.training import checkpoint as checkpoints
from nerfies_jax.training import programs, specs
from nerfies_jax.training.model import View, in_default_precision

PRESET = "splats-static"
OWN = ("preset", "steps", "seed")  # settings besides those of the preset
# Parts of a scene that need timestamps, which nerfbaselines' datasets do not have.
MOTIONS = ("motion", "warp", "time", "scene_flow")
SETTINGS, CAMERAS, STATES = "settings.json", "cameras.npz", "states"


class NerfiesJax:
    """A model that nerfbaselines trains, renders, saves and loads.

    It fulfills `nerfbaselines.Method`, a protocol, so that package is not imported.

    Args:
      checkpoint: Folder that `save` wrote, or None for a new model.
      train_dataset: Dataset to train on, with loaded images. None to render only.
      config_overrides: Settings by name: `preset`, `steps`, `seed`, and fields of the
        preset by their path, such as `sh_degree`.

    Raises:
      ValueError: If settings are wrong, or are not those of the checkpoint.
    """

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Any = None,
        config_overrides: dict[str, Any] | None = None,
    ):
        self._checkpoint = None if checkpoint is None else pathlib.Path(checkpoint)
        settings = {str(k): str(v) for k, v in (config_overrides or {}).items()}
        about = None
        if self._checkpoint is not None:
            about = json.loads((self._checkpoint / SETTINGS).read_text())
            checkpoint_settings = about["settings"]
            if settings and settings != checkpoint_settings:
                raise ValueError(
                    f"{checkpoint} was made with the settings "
                    f"{checkpoint_settings}, but these are {settings}; leave "
                    "them out, or train a new model"
                )
            settings = checkpoint_settings
        elif train_dataset is None:
            raise ValueError("pass a checkpoint, a train_dataset, or both")
        self._settings = settings
        self._config = _config(settings)
        self._spec = run.scene_spec(self._config)
        _refuse_motion(self._spec, self._config.preset_name)
        if train_dataset is not None:
            self._capture = conversion.capture_of(train_dataset)
        elif self._checkpoint is not None:
            self._capture = conversion.load_cameras(self._checkpoint / CAMERAS)
        representation = of_preset(self._config.preset_name)
        metadata = representation.metadata_of(self._capture, self._spec)
        if about is not None:
            # Computed again, numbers may differ in their last bits.
            kinds = representation.spec_type, type(metadata)
            metadata = specs.from_json(about["metadata"], *kinds)
        self._metadata = metadata
        self._model = model = representation.build(self._spec, metadata)
        self._state = self._first_state()
        self._loaded_step = self._step if self._checkpoint is not None else None
        self._frames = None
        if train_dataset is not None:
            self._frames = frames_of(self._capture, model.required_data)
        self._advance = programs.Program(_step, model)
        self._events = collections.defaultdict(list)
        for event in model.events:
            for step in event.steps:
                self._events[step].append(event)
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def _first_state(self):
        key = jax.random.key(self._config.seed)
        if self._checkpoint is None:
            return self._model.init(self._capture, key)
        example = (self._model.example or self._model.init)(self._capture, key)
        folder = self._checkpoint / STATES
        return checkpoints.restore(folder, example, self._model.spec).state

    @property
    def _step(self) -> int:
        """Number of completed steps."""
        return int(self._state.step)

    @property
    def capture(self) -> Capture:
        """The training capture, with black images if the model was only loaded."""
        return self._capture

    @classmethod
    def get_method_info(cls) -> Any:
        """Return what nerfbaselines has to know before it loads a dataset."""
        return {
            "method_id": "nerfies-jax",
            "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
            "supported_camera_models": frozenset(conversion.CAMERA_MODELS),
            "supported_outputs": (
                "color",
                {"name": "depth", "type": "depth"},
                {"name": "accumulation", "type": "depth"},
            ),
            "can_resume_training": True,
            "viewer_default_resolution": 512,
        }

    def get_info(self) -> Any:
        """Return the number of steps and the settings of this model."""
        path = None if self._checkpoint is None else str(self._checkpoint)
        settings = {"preset": self._config.preset_name, "seed": self._config.seed}
        return {
            **self.get_method_info(),
            "num_iterations": self._spec.steps,
            "loaded_step": self._loaded_step,
            "loaded_checkpoint": path,
            "hparams": {**self._settings, **settings, "steps": self._spec.steps},
        }

    def get_train_embedding(self, index: int) -> np.ndarray | None:
        """Return None: all images share one appearance."""
        del index
        return None

    def optimize_embedding(self, dataset: Any, *, embedding: Any = None) -> Any:
        """Refuse: there is no code of an image to optimize.

        Raises:
          NotImplementedError: Always.
        """
        raise NotImplementedError("nerfies-jax has one appearance for all images")

    def train_iteration(self, step: int) -> dict[str, float]:
        """Make one step, and apply the events after it.

        Args:
          step: Number of completed steps.

        Returns:
          Metrics of the step.

        Raises:
          ValueError: If another step is due, or the model has no training images.
          FloatingPointError: If a metric is not finite.
        """
        if self._frames is None:
            raise ValueError("this model was loaded to render; pass a train_dataset")
        if step != self._step:
            raise ValueError(f"step {self._step} is due, got step={step}")
        self._state, metrics = self._advance(self._state, self._frames)
        for event in self._events[step + 1]:
            self._state = event.apply(self._state, self._frames)
        numbers = {name: float(value) for name, value in metrics.items()}
        bad = sorted(name for name, x in numbers.items() if not math.isfinite(x))
        if bad:
            raise FloatingPointError(
                f"{', '.join(bad)} of step {step} is not finite; lower the learning "
                "rates, or start with another seed"
            )
        if numbers.get("mse", 0) > 0:
            numbers["psnr"] = -10 * math.log10(numbers["mse"])
        return numbers

    def render(
        self, camera: Any, *, options: Mapping[str, Any] | None = None
    ) -> dict[str, np.ndarray]:
        """Render an image.

        Args:
          camera: One `nerfbaselines.Cameras`.
          options: `outputs` limits the result to these names.

        Returns:
          `color` [height, width, 3] in [0, 1], and z-`depth` in world units and
          `accumulation`, both [height, width].
        """
        width, height = np.reshape(camera.image_sizes, -1).tolist()
        size = (int(width), int(height))
        if size not in self._renderers:
            self._renderers[size] = Renderer(self._model, size)
        rendering = self._renderers[size](self._state, self._view(camera))
        assert rendering.depth is not None
        images = {
            "color": np.clip(rendering.color, 0, 1),
            "depth": rendering.depth / self._capture.scale,
            "accumulation": rendering.alpha,
        }
        outputs = (options or {}).get("outputs") or images
        return {k: np.asarray(v, np.float32) for k, v in images.items() if k in outputs}

    def _view(self, one):
        cameras = conversion.world_cameras(one)
        cameras = conversion.in_scene_units(cameras, self._capture)
        view = View(camera.take(cameras, 0), np.float32(0), np.int32(0))
        return in_default_precision(view)

    def save(self, path: str) -> None:
        """Write a checkpoint that `checkpoint` takes.

        Args:
          path: Folder to write.
        """
        folder = pathlib.Path(path)
        if self._step == self._loaded_step and self._checkpoint is not None:
            shutil.copytree(self._checkpoint, folder, dirs_exist_ok=True)
            return
        folder.mkdir(parents=True, exist_ok=True)
        about = {"settings": self._settings, "metadata": specs.as_json(self._metadata)}
        (folder / SETTINGS).write_text(json.dumps(about))
        conversion.save_cameras(folder / CAMERAS, self._capture)
        with checkpoints.Checkpoints(folder / STATES, self._model.spec) as writer:
            writer.save(self._state, self._step)

    def export_gaussian_splats(
        self, *, options: Mapping[str, Any] | None = None
    ) -> dict[str, np.ndarray]:
        """Return the Gaussians in world units, for nerfbaselines' demos.

        Args:
          options: Ignored.

        Returns:
          `means` [n, 3], `scales` [n, 3], `opacities` [n], `quaternions` [n, 4] with
          the real part first, and `spherical_harmonics` [n, 3, coefficients].

        Raises:
          NotImplementedError: If the model is not made of Gaussians.
        """
        del options
        if self._model.stages is None:
            name = self._config.preset_name
            raise NotImplementedError(f"preset {name} has no Gaussians")
        rows = single_time.splats_at(self._model, self._state)(0.0)
        active = np.asarray(splats.active_mask(rows))
        rows = single_time.in_world(rows, self._capture)
        rows = jax.tree.map(lambda leaf: np.asarray(leaf)[active], rows)
        harmonics = np.concatenate([rows.sh_dc, rows.sh_rest], axis=1)
        return {
            "means": rows.mean,
            "scales": np.exp(rows.log_scale),
            "opacities": 1 / (1 + np.exp(-rows.opacity_logit)),
            "quaternions": rows.quaternion,
            "spherical_harmonics": harmonics.transpose(0, 2, 1),
        }


def _step(model, state, frames):
    return model.step(state, frames)


def _config(settings):
    """Return the config of a run with these settings."""
    numbers = {}
    for name in ("steps", "seed"):
        if name in settings:
            try:
                numbers[name] = int(settings[name])
            except ValueError:
                message = f"{name}={settings[name]} must be a whole number"
                raise ValueError(message) from None
    return RunConfig(
        preset=settings.get("preset", PRESET),
        overrides=tuple(f"{k}={v}" for k, v in settings.items() if k not in OWN),
        **numbers,
    )


def _refuse_motion(spec, preset):
    parts = [name for name in MOTIONS if getattr(spec, name, None) is not None]
    if parts:
        raise ValueError(
            f"preset {preset} needs timestamps for {', '.join(parts)}, which datasets "
            f"of nerfbaselines do not have; use a static preset such as {PRESET}"
        )
