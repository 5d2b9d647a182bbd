"""Draw the basis and the blending weights of a MoBa-GS run, as in its Figure 1.

    nerfies study motion_basis RUN
    nerfies study motion_basis RUN --bases 3 --times 4 --out basis.png

The first row has observed images. The second has the directions of the basis vectors
that move the scene most, which do not depend on time: red, green and blue are x, y and
z, and gray is none. The third has the weights of the first of them at the times of the
images: orange is positive, blue negative and gray zero.
"""

import dataclasses
import pathlib

import numpy as np

from experiments import cli
from nerfies_jax.runs import platform
from nerfies_jax.runtime import console


@dataclasses.dataclass(frozen=True)
class MotionBasis:
    """Draw the basis and the weights of a run with a motion basis."""

    run: cli.Positional[pathlib.Path]
    """Folder of a run of moba or moba-small."""
    bases: int = 4
    """Basis vectors to draw."""
    times: int = 4
    """Observed images to draw."""
    out: pathlib.Path = pathlib.Path("basis.png")
    """The image, PNG."""

    def __post_init__(self):
        for name in ("bases", "times"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} {getattr(self, name)}: at least 1")
        cli.check_out_file(self.out, "--out")


@cli.command(MotionBasis)
def main(args):
    """Run the command. Wrong input ends it with exit code 2."""
    with cli.user_errors():
        platform.start_jax("cpu", "one")
        rows = images(args.run, args.bases, args.times)
    draw(rows, args.out)
    console.say(f"image: {args.out}")
    return {"image": str(args.out)}


def images(folder: pathlib.Path, bases: int, times: int) -> dict[str, list]:
    """Render the rows of the figure.

    Args:
      folder: Run folder.
      bases: Number of basis vectors.
      times: Number of observed images.

    Returns:
      Images [height, width, 3] in [0, 1] by the title of their row.

    Raises:
      ValueError: If the run has no motion basis.
    """
    from gaussians_jax.motion import basis as motion_basis
    from gaussians_jax.motion.basis import BasisMotionSpec
    from nerfies_jax import evaluation, runs

    run = runs.saved_run(folder)
    spec = getattr(run.spec, "motion", None)
    if not isinstance(spec, BasisMotionSpec) or spec.count is None:
        raise ValueError(
            f"{folder}: its motion is {type(spec).__name__}, which has no basis; name "
            "a run of moba or moba-small"
        )
    state = runs.restore(folder, run).state
    render = evaluation.Renderer(run.model, run.capture.size)
    rows = evaluation.spread(run.observed.train, times)
    views = [evaluation.view_of(run.capture, row) for row in rows]
    params = state.params.nets[motion_basis.NAME]
    mean = state.params.rows["splats"].mean
    cache = motion_basis.prepare(params, spec, mean)
    weights = [
        np.asarray(motion_basis.blending_weights(params, spec, mean, view.time, cache))
        for view in views
    ]
    basis = np.asarray(cache.basis)  # [gaussians, 3, count]
    order = largest(basis, np.stack(weights))[:bases]
    images = [run.observed.images[row] / 255 for row in rows]
    directions = [
        np.asarray(render(paint(state, signed_color(basis[..., k])), views[0]).color)
        for k in order
    ]
    of_first = [
        np.asarray(render(paint(state, diverging(one[:, order[0]])), view).color)
        for one, view in zip(weights, views, strict=True)
    ]
    return {
        "observed images": images,
        "basis vectors, at all times": directions,
        "weights of the first": of_first,
    }


def largest(basis: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sort basis vectors by the motion that they contribute, largest first.

    Args:
      basis: Basis vectors, [gaussians, 3, count].
      weights: Their weights, [times, gaussians, count].

    Returns:
      Indices. The contribution is the variance over time of the weight, times the
      squared length of the vector, summed over the Gaussians.
    """
    motion = np.var(weights, axis=0) * np.sum(basis**2, axis=1)
    return np.argsort(-motion.sum(axis=0))


def signed_color(vectors: np.ndarray) -> np.ndarray:
    """Color vectors by their components, relative to the longest.

    Args:
      vectors: Vectors, [gaussians, 3].

    Returns:
      Colors in [0, 1], [gaussians, 3]. Gray is a vector of length zero.
    """
    longest = np.linalg.norm(vectors, axis=1).max()
    return 0.5 + 0.5 * vectors / (longest if longest > 0 else 1)


def diverging(values: np.ndarray) -> np.ndarray:
    """Color values from blue over gray to orange, relative to a robust maximum.

    Args:
      values: Values, [gaussians].

    Returns:
      Colors in [0, 1], [gaussians, 3].
    """
    most = np.quantile(np.abs(values), 0.99)
    share = np.clip(values / (most if most > 0 else 1), -1, 1)[:, None]
    blue, gray, orange = np.array([[0.1, 0.4, 0.9], [0.5, 0.5, 0.5], [0.95, 0.5, 0.1]])
    ends = np.where(share > 0, orange, blue)
    return gray + np.abs(share) * (ends - gray)


def paint(state, color: np.ndarray):
    """Return a state whose Gaussians have colors that do not depend on the view.

    Args:
      state: Trained state of a scene of Gaussians.
      color: Colors in [0, 1], [gaussians, 3].

    Returns:
      The state.
    """
    degree_0 = 0.5 * np.pi**-0.5  # the constant spherical harmonic
    rows = state.params.rows["splats"]
    rest = np.zeros_like(rows.sh_rest)
    sh_dc = ((color - 0.5) / degree_0).astype(rest.dtype)[:, None]
    rows = rows._replace(sh_dc=sh_dc, sh_rest=rest)
    new_rows = state.params.rows | {"splats": rows}
    return state._replace(params=state.params._replace(rows=new_rows))


def draw(rows: dict[str, list], path: pathlib.Path) -> None:
    """Write the figure.

    Args:
      rows: Images by the title of their row.
      path: The PNG file.

    Raises:
      MissingExtra: If matplotlib is not installed.
    """
    from nerfies_jax.visualization import figures

    columns = max(map(len, rows.values()))
    height, width = next(iter(rows.values()))[0].shape[:2]
    size = (2.1 * columns, (2.1 * height / width + 0.25) * len(rows))
    figure = figures.new_figure(figsize=size, dpi=100, layout="constrained")
    all_axes = figure.subplots(len(rows), columns, squeeze=False)
    for axes, (title, images) in zip(all_axes, rows.items(), strict=True):
        for one in axes:
            one.axis("off")
        for one, image in zip(axes, images, strict=False):
            one.imshow(np.clip(image, 0, 1))
        axes[0].set_title(title, fontsize=9, loc="left")
    figures.save(figure, path, {title: len(images) for title, images in rows.items()})


if __name__ == "__main__":
    main()
