"""The plugin for nerfstudio starts a run, and answers with its metrics.

nerfstudio is large and pins versions, so that classes with the documented signatures of
1.1.5 stand for it here.
"""

import dataclasses
import importlib.metadata
import json
import pathlib
import sys
import types

import pytest

from experiments import cli, reconstruct

METRICS = {"heldout.psnr": 31.5, "heldout.ssim": 0.9, "train.steps": 40}
# It writes what it was called with, and what a run leaves that nerfstudio asks for.
COMMAND = """\
#!{python}
import json, pathlib, sys
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
out.mkdir(parents=True)
(out / "words.json").write_text(json.dumps(sys.argv[1:]))
(out / "metrics.json").write_text({metrics!r})
(out / "comparison.png").write_bytes(b"images")
sys.exit({code})
"""


@dataclasses.dataclass
class DataManagerConfig:
    data: pathlib.Path | None = None


@dataclasses.dataclass
class VanillaPipelineConfig:
    _target: type = object
    datamanager: DataManagerConfig = dataclasses.field(
        default_factory=DataManagerConfig
    )

    def setup(self, **kwargs):
        return self._target(self, **kwargs)


@dataclasses.dataclass
class MachineConfig:
    seed: int = 42


@dataclasses.dataclass
class TrainerConfig:
    _target: type = object
    method_name: str | None = None
    machine: MachineConfig = dataclasses.field(default_factory=MachineConfig)
    pipeline: VanillaPipelineConfig = dataclasses.field(
        default_factory=VanillaPipelineConfig
    )
    output_dir: pathlib.Path = pathlib.Path("outputs")

    def setup(self, **kwargs):
        return self._target(self, **kwargs)

    def get_base_dir(self):
        return self.output_dir / self.method_name

    def get_checkpoint_dir(self):
        return self.get_base_dir() / "nerfstudio_models"


@dataclasses.dataclass
class MethodSpecification:
    config: TrainerConfig
    description: str


class Pipeline:
    """An abstract module of torch."""


@pytest.fixture
def plugin(monkeypatch):
    def module(name, **members):
        made = types.ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)

    def save(state, path):
        path.write_text(json.dumps(state))

    module("torch", save=save)
    for name in ("", ".engine", ".pipelines", ".plugins"):
        module(f"nerfstudio{name}")
    module("nerfstudio.engine.trainer", TrainerConfig=TrainerConfig)
    module(
        "nerfstudio.pipelines.base_pipeline",
        Pipeline=Pipeline,
        VanillaPipelineConfig=VanillaPipelineConfig,
    )
    module("nerfstudio.plugins.types", MethodSpecification=MethodSpecification)
    name = "experiments.plugins.nerfstudio_method"
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module(name)
    sys.modules.pop(name, None)


@pytest.fixture
def config(plugin, tmp_path):
    def configured(code=0, data=tmp_path / "capture", **changes):
        executable = tmp_path / "nerfies"
        executable.write_text(
            COMMAND.format(
                python=sys.executable, metrics=json.dumps(METRICS), code=code
            )
        )
        executable.chmod(0o755)
        made = dataclasses.replace(
            plugin.METHOD.config,
            **{"executable": str(executable), "output_dir": tmp_path, **changes},
        )
        made.pipeline.datamanager.data = data
        return made

    return configured


def test_a_run_is_started_and_evaluated(plugin, config, tmp_path, monkeypatch):
    settings = config(steps=40, preset="spacetime-small", changes=("sh_degree=1",))
    trainer = settings.setup(local_rank=0, world_size=1)  # as ns-train does
    trainer.setup()
    trainer.train()
    (checkpoint,) = (tmp_path / "nerfies-jax/nerfstudio_models").iterdir()
    assert checkpoint.name == "step-000000040.ckpt"
    state = json.loads(checkpoint.read_text())
    words = json.loads(
        (pathlib.Path(state["pipeline"]["run"]) / "words.json").read_text()
    )
    monkeypatch.delitem(sys.modules, "torch")  # which tyro looks for
    parsed = cli.parse(reconstruct.Reconstruct, words[1:])
    assert (words[0], parsed.source.capture) == ("reconstruct", tmp_path / "capture")
    assert (parsed.preset, parsed.steps, parsed.seed) == ("spacetime-small", 40, 42)
    assert parsed.set == ("sh_degree=1",)
    assert parsed.out == tmp_path / "nerfies-jax/run"
    pipeline = settings.pipeline.setup(device="cpu", test_mode="test")  # ns-eval
    pipeline.load_pipeline(state["pipeline"], state["step"])
    (tmp_path / "images").mkdir()
    metrics = pipeline.get_average_eval_image_metrics(
        output_path=tmp_path / "images", get_std=True
    )
    assert metrics == {"psnr": 31.5, "ssim": 0.9}
    assert (tmp_path / "images/comparison.png").read_bytes() == b"images"


def test_what_cannot_run_is_refused(plugin, config, tmp_path):
    with pytest.raises(ValueError, match="--data FOLDER"):
        config(data=None).setup().setup()
    with pytest.raises(ValueError, match=r"nowhere: no such command.*--executable"):
        config(executable=str(tmp_path / "nowhere")).setup().setup()
    with pytest.raises(ValueError, match="2 processes"):
        config().setup(world_size=2)
    trainer = config(code=3).setup()
    trainer.setup()
    with pytest.raises(RuntimeError, match="ended with code 3"):
        trainer.train()
    assert not (tmp_path / "nerfies-jax/nerfstudio_models").exists()


def test_nerfstudio_finds_the_method_by_its_entry_point(plugin):
    points = importlib.metadata.entry_points(group="nerfstudio.method_configs")
    values = {point.value for point in points if point.name == "nerfies-jax"}
    assert values <= {f"{plugin.__name__}:METHOD"}
    assert isinstance(plugin.METHOD, MethodSpecification)
    assert plugin.METHOD.config.method_name == "nerfies-jax"
