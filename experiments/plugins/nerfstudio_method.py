"""The method `nerfies-jax` of nerfstudio, which loads this module by its entry point.

Methods of nerfstudio are torch modules. A model in JAX is none, so the method replaces
nerfstudio's trainer by one that runs `nerfies reconstruct`, here or in an environment
of its own, and its pipeline answers `ns-eval` with the metrics of that run.
"""

import dataclasses
import json
import pathlib
import shlex
import shutil
import subprocess
from typing import Any

import torch
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline, VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from nerfies_jax.runtime import console

NAME = "nerfies-jax"
RUN = "run"  # the run folder, next to nerfstudio's own files
METRICS = {"psnr": "heldout.psnr", "ssim": "heldout.ssim", "lpips": "heldout.lpips"}


@dataclasses.dataclass
class NerfiesJaxPipelineConfig(VanillaPipelineConfig):
    """Settings of the pipeline, whose data manager only names the capture."""

    _target: type = dataclasses.field(default_factory=lambda: NerfiesJaxPipeline)


@dataclasses.dataclass
class NerfiesJaxConfig(TrainerConfig):
    """Settings of `ns-train nerfies-jax`."""

    _target: type = dataclasses.field(default_factory=lambda: NerfiesJaxTrainer)
    method_name: str | None = NAME
    pipeline: VanillaPipelineConfig = dataclasses.field(
        default_factory=NerfiesJaxPipelineConfig
    )
    preset: str | None = None
    """Preset (default: chosen by the capture)."""
    steps: int | None = None
    """Training steps (default: those of the preset)."""
    changes: tuple[str, ...] = ()
    """Fields of the preset, as FIELD=VALUE (nerfies settings NAME lists them)."""
    executable: str = "nerfies"
    """The command, or its path in an environment of its own."""


class NerfiesJaxTrainer:
    """Trains one model by `nerfies reconstruct`.

    Args:
      config: Settings of the method.
      local_rank: Ignored. One process trains.
      world_size: Number of processes.

    Raises:
      ValueError: If several processes are requested.
    """

    def __init__(
        self, config: NerfiesJaxConfig, local_rank: int = 0, world_size: int = 1
    ):
        if world_size != 1:
            raise ValueError(
                f"{world_size} processes: {NAME} trains in one, which uses all devices"
            )
        self.config = config

    def setup(self, test_mode: str = "val") -> None:
        """Check the settings.

        Args:
          test_mode: Ignored. The command loads the capture.

        Raises:
          ValueError: If there is no capture or no command.
        """
        if self.config.pipeline.datamanager.data is None:
            raise ValueError("no data: name a capture with --data FOLDER")
        if shutil.which(self.config.executable) is None:
            raise ValueError(
                f"{self.config.executable}: no such command; name the one of the "
                "environment that has nerfies-jax with --executable"
            )

    def train(self) -> None:
        """Train, and write the checkpoint that `ns-eval` looks for.

        Raises:
          RuntimeError: If the command fails. It has printed the reason.
        """
        folder = pathlib.Path(self.config.get_base_dir()).resolve() / RUN
        command = command_line(self.config, folder)
        console.say(shlex.join(command))
        code = subprocess.run(command, check=False).returncode
        if code:
            raise RuntimeError(f"{command[0]} ended with code {code}")
        steps = int(json.loads((folder / "metrics.json").read_text())["train.steps"])
        checkpoints = pathlib.Path(self.config.get_checkpoint_dir())
        checkpoints.mkdir(parents=True, exist_ok=True)
        state = {"step": steps, "pipeline": {"run": str(folder)}}
        torch.save(state, checkpoints / f"step-{steps:09d}.ckpt")


class NerfiesJaxPipeline(Pipeline):
    """A trained run, for `ns-eval`, which calls nothing else of a pipeline.

    Args:
      config: Settings of the pipeline.
      device: Ignored, like all others, which nerfstudio gives to pipelines.
      test_mode: Ignored.
      world_size: Ignored.
      local_rank: Ignored.
      grad_scaler: Ignored.
    """

    def __init__(
        self,
        config: NerfiesJaxPipelineConfig,
        device: Any = "cpu",
        test_mode: str = "val",
        world_size: int = 1,
        local_rank: int = 0,
        grad_scaler: Any = None,
    ):
        super().__init__()
        self.config = config
        self._folder = pathlib.Path()

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Remember the run of a checkpoint.

        Args:
          loaded_state: What `NerfiesJaxTrainer.train` saved.
          step: Number of its steps.
        """
        self._folder = pathlib.Path(loaded_state["run"])

    def get_average_eval_image_metrics(
        self,
        step: int | None = None,
        output_path: pathlib.Path | None = None,
        get_std: bool = False,
    ) -> dict[str, float]:
        """Return the metrics of the held-out images.

        Args:
          step: Ignored. The run was scored at its end.
          output_path: Folder for a copy of the rendered held-out images next to the
            truth, or None.
          get_std: Ignored. A run keeps no deviations.

        Returns:
          PSNR in dB, SSIM and, if it was computed, LPIPS.
        """
        numbers = json.loads((self._folder / "metrics.json").read_text())
        if output_path is not None:
            shutil.copy(self._folder / "comparison.png", output_path)
        return {name: numbers[key] for name, key in METRICS.items() if key in numbers}


def command_line(config: NerfiesJaxConfig, folder: pathlib.Path) -> list[str]:
    """Build the command of a run.

    Args:
      config: Settings of the method.
      folder: The run folder.

    Returns:
      The words of the command.
    """
    data = str(config.pipeline.datamanager.data)
    words = [config.executable, "reconstruct", data, "--out", str(folder)]
    words += ["--seed", str(config.machine.seed)]
    if config.preset is not None:
        words += ["--preset", config.preset]
    if config.steps is not None:
        words += ["--steps", str(config.steps)]
    return words + (["--set", *config.changes] if config.changes else [])


METHOD = MethodSpecification(
    NerfiesJaxConfig(), "Dynamic and static Gaussian splats and NeRF fields in JAX."
)
