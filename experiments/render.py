"""Render a finished run: held-out frames, camera paths, frozen time, slow motion.

python -m experiments.render RUN                         # the held-out frames
python -m experiments.render RUN --path orbit            # mp4 of the moving scene
python -m experiments.render RUN --path sway --freeze 0.5
"""

import dataclasses
import pathlib
from typing import Literal

import numpy as np

from experiments import settings as run_settings

RATE = 24.0  # frames per second of the films


@dataclasses.dataclass(frozen=True)
class Render:
    """Render a finished run, as PNG, mp4 and EXR."""

    run: run_settings.Positional[pathlib.Path]
    """Run folder that experiments.reconstruct made."""
    path: Literal["heldout", "sway", "orbit", "captured"] = "heldout"
    """Held-out frames, or a camera moving within the filmed span, in a circle, or as it
    was filmed."""
    frames: int = 96
    """Pictures along a camera path."""
    freeze: float | None = None
    """Stop the scene at this time in [0, 1]; the camera goes on."""
    slow: float = 1.0
    """Play so many times slower: 4 shows a quarter of the scene in the same frames."""
    out: pathlib.Path | None = None
    """Folder for the pictures (default: RUN/renders/PATH)."""
    formats: tuple[Literal["png", "mp4", "exr"], ...] = ("png", "mp4")
    """What to write: png pictures, one mp4, exr with linear colour, alpha and depth."""
    max_side: int | None = None
    """Longest side of the pictures, in pixels (default: as trained)."""
    device: Literal["auto", "cpu", "gpu", "tpu"] = "auto"
    """Where to compute."""

    def __post_init__(self):
        if self.frames < 1:
            raise ValueError(f"--frames {self.frames}: render at least one")
        if self.freeze is not None and not 0 <= self.freeze <= 1:
            raise ValueError(f"--freeze {self.freeze}: the time lies in [0, 1]")
        if not self.slow > 0:
            raise ValueError(f"--slow {self.slow}: a positive factor; 4 is slow motion")
        if not self.formats:
            raise ValueError("--formats: name at least one of png, mp4, exr")


def main(arguments=None):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with run_settings.user_errors():
        asked = run_settings.parse(Render, arguments)
        threads = run_settings.threads_for(run_settings.stored_preset(asked.run))
        run_settings.start_jax(asked.device, threads)
        from experiments import runs

        run = runs.saved_run(asked.run)
        state = runs.restore(asked.run, run).state
        out = asked.out or asked.run / "renders" / _name(asked)
        out.mkdir(parents=True, exist_ok=True)
        names, views = _views(asked, run)
    _write(asked, out, run, state, names, views)


def _name(asked):
    frozen = "" if asked.freeze is None else f"-at-{asked.freeze:g}"
    slow = "" if asked.slow == 1 else f"-slow-{asked.slow:g}"
    return f"{asked.path}{frozen}{slow}"


def _views(asked, run):
    """Names and views of all pictures."""
    from experiments import camera_paths, evaluate

    if asked.path == "heldout":
        rows = run.capture.heldout
        views = [evaluate.view_of(run.capture, row) for row in rows]
        names = [pathlib.PurePath(run.capture.ids[row]).name for row in rows]
        if asked.freeze is not None:
            time = views[0].time.dtype.type(asked.freeze)
            views = [view._replace(time=time) for view in views]
        return names, views
    path = camera_paths.path(asked.path, run.capture, asked.frames)
    if asked.freeze is None:
        times = camera_paths.times(asked.frames, loops=1 / asked.slow)
    else:
        times = np.full(asked.frames, asked.freeze, np.float32)
    like = evaluate.view_of(run.capture, int(run.capture.train[0]))
    names = [f"{number:04d}" for number in range(asked.frames)]
    return names, evaluate.path_views(path, times, like)


def _write(asked, out, run, state, names, views):
    """Render view after view and write each as it comes."""
    from experiments import evaluate
    from nerfies_jax.capture import exr, images, video

    size = _size(run.capture.size, asked.max_side)
    renderer = evaluate.Renderer(run.model, size)

    def pictures():
        for name, view in zip(names, views, strict=True):
            rendering = renderer(state, evaluate.resized(view, run.capture.size, size))
            picture = evaluate.as_picture(rendering.colour)
            if "png" in asked.formats:
                images.write_png(out / f"{name}.png", picture)
            if "exr" in asked.formats:
                exr.write_exr(
                    out / f"{name}.exr",
                    colour=images.linear_from_srgb(np.clip(rendering.colour, 0, 1)),
                    alpha=rendering.alpha,
                    depth=rendering.depth,
                )
            yield picture

    if "mp4" in asked.formats:
        video.write_video(out / "film.mp4", pictures(), RATE)
    else:
        for _ in pictures():
            pass
    print(
        f"{len(names)} pictures of {size[0]}x{size[1]}, "
        f"{renderer.ms_per_frame(len(names)):.0f} ms each, in {out}"
    )


def _size(size, max_side):
    if max_side is None:
        return size
    factor = max_side / max(size)
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


if __name__ == "__main__":
    main()
