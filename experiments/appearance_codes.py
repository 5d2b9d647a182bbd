"""Do appearance codes and a transient medium pay for themselves?

    python -m experiments.appearance_codes --scene exposure
    python -m experiments.appearance_codes --scene transient --steps 1000 --seeds 3

Trains the small static NeRF with and without the effect, for the same steps, on a still
life of which the truth is known. `exposure`: brightness drifts; held-out instants have
exposures never seen, so codes are fitted to the left half of a frame and the right half
is scored (Martin-Brualla et al. 2021). `transient`: a post passes before the
camera; frames it is in are rendered without it and compared with the same scene filmed
without it, where it stood and elsewhere. Over several seeds a number is a mean, with
its standard deviation; the picture is of the first.
"""

import dataclasses
import pathlib
from typing import Literal

import numpy as np

from experiments import cli, markdown
from nerfies_jax import console
from nerfies_jax.runs import platform

SHOWN = 4  # frames in the picture
SCORED = 12  # frames with a transient in them


@dataclasses.dataclass(frozen=True)
class AppearanceCodes:
    """Train with and without appearance codes, or a transient medium; compare."""

    scene: Literal["exposure", "transient"] = "exposure"
    """What varies between the frames."""
    steps: int = 3000
    """Of training, for each of the two."""
    size: tuple[int, int] = (176, 132)
    """Width and height of the frames in pixels."""
    seeds: int = 1
    """Of the scene, the first parameters and the rays: 0, 1, ..."""
    out: pathlib.Path | None = None
    """Folder for figures.json and picture.png (default: codes_SCENE)."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to train."""

    def __post_init__(self):
        cli.check_out_folder(self.folder)
        for name in ("steps", "seeds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")

    @property
    def folder(self) -> pathlib.Path:
        """Where the results go."""
        return self.out or pathlib.Path(f"codes_{self.scene}")


@cli.command(AppearanceCodes)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        platform.start_jax(args.device, "all")
        compare = {"exposure": compare_exposure, "transient": compare_transient}
        film = filmed(args.scene, args.size)
        every = [compare[args.scene](film, args.steps, n) for n in range(args.seeds)]
        return _write(args, [figures for figures, _ in every], every[0][1])


def filmed(scene, size):
    """The still life under drifting light, or with something passing by."""
    from nerfies_jax.capture import synthetic

    # Still, so that what a static field cannot explain is the effect's alone.
    return dataclasses.replace(
        synthetic.PRESETS[scene],
        things=synthetic.PRESETS["static"].things,
        size=size,
        # Of the instants the second camera looks at, the first learns nothing.
        skip_every=4 if scene == "exposure" else None,
    )


def compare_exposure(film, steps, seed):
    """PSNR of the right halves of the second camera's frames, and a picture."""
    from nerfies_jax import evaluation, held_out_codes, presets
    from nerfies_jax.capture import synthetic

    capture, _ = synthetic.make(film, seed)
    rows = capture.heldout[capture.camera_ids[capture.heldout] == 1]
    plain_spec = dataclasses.replace(presets.SMALL_NERF, steps=steps)
    codes = presets.SMALL_NERF_W.appearance
    coded_spec = dataclasses.replace(plain_spec, appearance=codes)
    drawn, figures = {}, {}
    for name, spec in (("without codes", plain_spec), ("with codes", coded_spec)):
        model, state, seconds = trained(spec, capture, seed)
        renderer = evaluation.Renderer(model, capture.size)
        drawn[name] = evaluation.score(renderer, state, capture, rows).color
        figures[f"{name}: seconds"] = seconds
        key = "without codes" if name == "without codes" else "codes of neighbors"
        figures[f"{key}: PSNR (dB)"] = _right_psnr(drawn[name], capture.images[rows])
    halves = held_out_codes.score(*model.spec, state, capture, rows)
    figures["codes fitted to the left half: PSNR (dB)"] = float(np.mean(halves.psnr))
    shown = evaluation.spread(np.arange(len(rows)), SHOWN)
    columns = {"truth": capture.images[rows], **drawn}
    return figures, _sheet(columns, shown, [capture.ids[row] for row in rows])


def compare_transient(film, steps, seed):
    """PSNR against the scene without its transient, and a picture."""
    from nerfies_jax import evaluation, presets, variants
    from nerfies_jax.capture import synthetic

    capture, truth = synthetic.make(film, seed)
    clean, _ = synthetic.make(dataclasses.replace(film, transient=None), seed)
    passed = np.flatnonzero(truth.transient.any((1, 2)))
    rows = evaluation.spread(passed, SCORED)
    masks = truth.transient[rows]
    plain = dataclasses.replace(presets.SMALL_NERF, steps=steps)
    medium = dataclasses.replace(plain, transient=presets.SMALL_NERF_W.transient)
    drawn, figures = {}, {}
    for name, spec in (("without the effect", plain), ("static part", medium)):
        model, state, seconds = trained(spec, capture, seed)
        left_out = () if spec.transient is None else ("transient",)
        static = variants.without_effects(*model.spec, left_out, False)
        renderer = evaluation.Renderer(static, capture.size)
        drawn[name] = evaluation.score(renderer, state, clean, rows).color
        held_out = evaluation.score(renderer, state, clean, clean.heldout)
        figures[f"{name}: seconds"] = seconds
        for place, where in (("where it stood", masks), ("elsewhere", ~masks)):
            psnr = _psnr(drawn[name], clean.images[rows], where)
            figures[f"{name}: PSNR {place} (dB)"] = psnr
        figures[f"{name}: PSNR held out (dB)"] = float(held_out.psnr.mean())
    whole = evaluation.Renderer(model, capture.size)
    drawn["with the transient"] = evaluation.score(whole, state, capture, rows).color
    figures["transient rendered: PSNR where it stood (dB)"] = _psnr(
        drawn["with the transient"], capture.images[rows], masks
    )
    shown = evaluation.spread(np.arange(len(rows)), SHOWN)
    columns = {"filmed": capture.images[rows], "truth": clean.images[rows], **drawn}
    return figures, _sheet(columns, shown, [capture.ids[row] for row in rows])


def trained(spec, capture, seed):
    """(model, state, seconds) after all steps of a spec."""
    import jax

    from nerfies_jax import evaluation, scene
    from nerfies_jax.training import loop

    model = scene.build(spec, scene.metadata_of(capture, spec))
    state = model.init(capture, jax.random.key(seed))
    frames = evaluation.frames_of(capture, model.required_data)
    result = loop.fit(model, state, frames, steps=spec.steps)
    if result.steps < spec.steps:
        raise ValueError(f"training ended early: {result.message}")
    return model, result.state, result.seconds


def _psnr(color, truth, where):
    """Decibels over all chosen pixels together, not a mean over frames."""
    error = np.round(color * 255) - truth.astype(np.float32)
    return float(-10 * np.log10(np.mean((error[where] / 255) ** 2)))


def _right_psnr(color, truth):
    """Mean over the frames of the PSNR of their right halves."""
    half = color.shape[2] // 2
    where = np.ones(color[0, :, half:].shape[:2], bool)
    pairs = zip(color[:, :, half:], truth[:, :, half:], strict=True)
    return float(np.mean([_psnr(one, true, where) for one, true in pairs]))


def _sheet(columns, shown, ids):
    """A row for each frame shown, a column for each way to see it."""
    from nerfies_jax.evaluation import pictures

    cells, captions = [], []
    for row in shown:
        for name, frames in columns.items():
            cells.append(pictures.as_bytes(frames[row]))
            captions.append(f"{ids[row]} {name}")
    return pictures.contact_sheet(cells, captions, columns=len(columns))


def _write(args, every, picture):
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.evaluation import pictures
    from nerfies_jax.measure import clock

    folder = args.folder
    folder.mkdir(parents=True, exist_ok=True)
    settled = {"scene": args.scene, "steps": args.steps, "size": list(args.size)}
    figures = {name: [one[name] for one in every] for name in every[0]}  # by seed
    record = {**settled, "machine": clock.machine(), "figures": figures}
    write_json(folder / "figures.json", record)
    pictures.save(picture, folder / "picture.png")
    for name, values in figures.items():
        console.say(f"{name:52} {markdown.over_seeds(values, 2):>16}")
    console.say(f"{folder / 'figures.json'}, {folder / 'picture.png'}")
    return record


def page(stored) -> str:
    """The page in docs/results below the docstring, from a figures.json."""
    width, height = stored["size"]
    figures = stored["figures"]
    rows = [[name, markdown.over_seeds(x, 2)] for name, x in figures.items()]
    count = len(next(iter(figures.values())))
    return (
        f"## {stored['scene'].capitalize()}, {stored['steps']:,} steps, "
        f"{width}x{height}, {count} seed{'s' if count > 1 else ''}\n\n"
        f"{markdown.table(('', 'measured'), rows)}"
    )


if __name__ == "__main__":
    main()
