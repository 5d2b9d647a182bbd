"""What becomes of the gates on spectral losses, and what they are good for.

    python -m experiments.frequency_gates
    python -m experiments.frequency_gates --steps 6000 --seeds 5 --most 0.5 --out gates

A small network of encoded coordinates learns one picture by L1 and the spectral losses
of `gaussians_jax.effects.spectral`, whose weights are ruled by each kind of gate. Two
rules that the library does not offer show why: "ascent" trains the gates against the
loss, "log" rewards open ones with 0.01 log sigma. The table and the figure show PSNR
and weights; the sentences below them are made from the numbers.
"""

import dataclasses
import math
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments import asked, cli, markdown
from gaussians_jax.effects import spectral
from gaussians_jax.effects.spectral import FourierSpec, SpectralSpec, WaveletSpec
from nerfies_jax import console
from nerfies_jax.nets import encoding, mlp
from nerfies_jax.runs import platform
from nerfies_jax.training import losses
from nerfies_jax.training.effects import weighted_sum

REWARD = 0.01  # of "log", for each gate's log sigma; as in the loss, in units of L1
WARNINGS = ("ascent", "log")
RULES = (*spectral.GATES, *WARNINGS)
# A difference between arms is called one from twice its standard error on.
CLEAR = 2.0


@dataclasses.dataclass(frozen=True)
class FrequencyGates:
    """Compare the gates of the spectral losses on one picture."""

    steps: int = 1500
    """Of Adam."""
    seeds: int = 4
    """Initial networks; the same ones for every arm."""
    most: tuple[float, ...] = (0.1, 1.0)
    """Weights of both losses at open gates. All gates start half open."""
    pixels: int = 48
    """Of a side of the picture."""
    width: int = 32
    """Of the network's two layers."""
    bands: int = 6
    """Of the encoding of the coordinates."""
    rate: float = 5e-3
    """Adam's, for the network; falls to zero along a cosine."""
    out: pathlib.Path | None = None
    """Folder for frequency_gates.png and frequency_gates.json."""
    device: str = "auto"
    """cpu, gpu, or whatever JAX finds."""

    def __post_init__(self):
        cli.check_out_folder(self.out)
        for name, least in (("steps", 10), ("seeds", 2), ("pixels", 8), ("width", 1)):
            if getattr(self, name) < least:
                raise ValueError(
                    f"--{name} {getattr(self, name)} must be at least {least}"
                )
        if not self.most or not all(0 < x < math.inf for x in self.most):
            raise ValueError(f"--most {self.most} must be positive numbers")


class GateSetting(NamedTuple):
    """One rule at one weight."""

    rule: str  # one of RULES, or "none"
    most: float | None

    @property
    def name(self) -> str:
        return self.rule if self.most is None else f"{self.rule} {self.most:g}"

    @property
    def spec(self) -> SpectralSpec | None:
        if self.rule == "none":
            return None
        gate = "learned" if self.rule in WARNINGS else self.rule
        return SpectralSpec(WaveletSpec(self.most), FourierSpec(self.most), gate)


class Fitted(NamedTuple):
    """One arm, over all seeds; the last axis is the step."""

    psnr: np.ndarray  # [seeds, steps] dB
    opening: np.ndarray | None  # [seeds, 2, steps] wavelet, Fourier: weight over most


def arms(args: FrequencyGates) -> list[GateSetting]:
    """No spectral loss, every gate at every weight, warnings at the largest."""
    settings = [GateSetting("none", None)]
    for most in args.most:
        settings += [GateSetting(gate, most) for gate in spectral.GATES]
    return settings + [GateSetting(rule, max(args.most)) for rule in WARNINGS]


def picture(pixels: int) -> np.ndarray:
    """Slow colors, a striped disc, a ring, a fine plaid and grain; in [0, 1]."""
    axis = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    y, x = np.meshgrid(axis, axis, indexing="ij")
    slow = [0.5 + 0.3 * x, 0.5 + 0.25 * np.sin(3 * y + x), 0.45 + 0.2 * x * y]
    stripes = 0.5 + 0.5 * np.sign(np.sin(2 * np.pi * (6 * x + 2 * y)))
    striped = [0.1 + 0.85 * stripes, 0.3 + 0.4 * stripes, 0.2 + 0 * x]
    disc = (x + 0.35) ** 2 + (y + 0.3) ** 2 < 0.18
    image = np.where(disc[..., None], np.stack(striped, -1), np.stack(slow, -1))
    ring = np.abs(np.hypot(x - 0.4, y - 0.35) - 0.35) < 0.06
    image = np.where(ring[..., None], [0.1, 0.6, 0.3], image)
    plaid = 0.08 * np.sin(2 * np.pi * 13 * x) * np.sin(2 * np.pi * 11 * y)
    grain = 0.06 * np.random.default_rng(0).normal(size=x.shape)
    image = image + np.where((x > 0) & (y < 0), plaid, 0)[..., None]
    image = image + np.where((x < 0) & (y > 0), grain, 0)[..., None]
    return np.clip(image, 0, 1).astype(np.float32)


def fit(arm: GateSetting, args: FrequencyGates) -> Fitted:
    """Train the arm from every seed at once."""
    truth = jnp.asarray(picture(args.pixels))
    draw, first = _network(args)
    spec = arm.spec
    has_gates = spec is not None and spec.gate in spectral.LEARNED
    rule = optax.adam(optax.cosine_decay_schedule(args.rate, args.steps))
    gate_rule = optax.adam(1e-2 if spec is None else spec.learning_rate)

    def loss(trained, step):
        image = draw(trained[0])
        value = losses.l1(image, truth)
        weight = None
        if spec is not None:
            weight = spectral.weights(spec, trained[1], step, args.steps)
            terms = spectral.terms(spec, weight, image, truth)
            value = value + weighted_sum(terms)
        if arm.rule == "log":
            value = value - REWARD * sum(map(jax.nn.log_sigmoid, trained[1]))
        return value, (losses.psnr(losses.mse(image, truth)), weight)

    def update(state, step):
        trained, memory = state
        slopes, seen = jax.grad(loss, has_aux=True)(trained, step)
        if arm.rule == "ascent":
            slopes = slopes[0], jax.tree.map(jnp.negative, slopes[1])
        turned = [
            each.update(slope, kept)
            for each, slope, kept in zip((rule, gate_rule), slopes, memory, strict=True)
        ]
        trained = tuple(
            optax.apply_updates(part, change)
            for part, (change, _) in zip(trained, turned, strict=True)
        )
        return (trained, tuple(kept for _, kept in turned)), seen

    def one(key):
        trained = first(key), spectral.init(spec) if has_gates else None
        memory = rule.init(trained[0]), gate_rule.init(trained[1])
        _, seen = jax.lax.scan(update, (trained, memory), jnp.arange(args.steps))
        return seen

    keys = jax.random.split(jax.random.key(0), args.seeds)
    # optax adds its step count to floats
    with jax.numpy_dtype_promotion("standard"):
        psnr, weight = jax.jit(jax.vmap(one))(keys)
    if weight is None:
        return Fitted(np.asarray(psnr), None)
    return Fitted(np.asarray(psnr), np.stack(weight, axis=1) / arm.most)


def _network(args):
    """Parameters to picture, and key to parameters."""
    axis = (np.arange(args.pixels) + 0.5) / args.pixels * 2 - 1
    y, x = np.meshgrid(axis, axis, indexing="ij")
    places = jnp.asarray(np.stack([x, y], -1).reshape(-1, 2), jnp.float32)
    waves = encoding.EncodingSpec(args.bands, times_pi=True)
    features = jax.vmap(lambda place: encoding.encode(waves, place, None))(places)
    heads = (("color", mlp.HeadSpec(3)),)
    spec = mlp.MLPSpec(features.shape[1], 2, args.width, heads, init="he")

    def draw(params):
        color = 0.5 + mlp.apply(spec, params, features)["color"]
        return color.reshape(args.pixels, args.pixels, 3)

    return draw, lambda key: mlp.init(spec, key)


def numbers(fitted: dict[GateSetting, Fitted]) -> dict[str, dict[str, float | None]]:
    """Of each arm: PSNR, its gain over no spectral loss (pairs of equal seeds), and
    both gates' openings half-way and at the end, in the mean over the seeds.
    """
    plain = fitted[GateSetting("none", None)].psnr[:, -1]
    rows = {}
    for arm, fits in fitted.items():
        last = fits.psnr[:, -1]
        gain = last - plain
        row = {
            "psnr": last.mean(),
            "psnr_deviation": last.std(ddof=1),
            "gain": gain.mean(),
            "gain_error": gain.std(ddof=1) / math.sqrt(len(gain)),
        }
        for index, name in enumerate(("wavelet", "fourier")):
            for when in ("start", "mid", "end"):
                row[f"{name}_{when}"] = _opening(fits, index, when)
        rows[arm.name] = {k: None if x is None else float(x) for k, x in row.items()}
    return rows


def _opening(fits, index, when):
    if fits.opening is None:
        return None
    steps = fits.opening.shape[-1]
    at = {"start": 0, "mid": steps // 2, "end": steps - 1}[when]
    return fits.opening[:, index, at].mean()


def table(rows: dict[str, dict[str, float | None]]) -> str:
    """The arms as text."""
    lines = [
        f"{'gate, most':14s} {'PSNR':>6s} {'+-':>5s} {'gain':>6s} {'s.e.':>5s}   "
        "wavelet opening mid, end   Fourier opening mid, end"
    ]
    for name, row in rows.items():
        line = (
            f"{name:14s} {row['psnr']:6.2f} {row['psnr_deviation']:5.2f} "
            f"{row['gain']:+6.2f} {row['gain_error']:5.2f}"
        )
        if row["wavelet_mid"] is not None:
            line += (
                f"   {row['wavelet_mid']:15.4f} {row['wavelet_end']:8.4f}   "
                f"{row['fourier_mid']:15.4f} {row['fourier_end']:8.4f}"
            )
        lines.append(line)
    return "\n".join(lines)


def format_conclusions(rows: dict[str, dict[str, float | None]]) -> str:
    """What the numbers show, in sentences."""
    sentences = []
    for name, row in rows.items():
        if not name.startswith("learned"):
            continue
        falls = all(
            row[f"{loss}_end"] < row[f"{loss}_mid"] < row[f"{loss}_start"]
            for loss in ("wavelet", "fourier")
        )
        sentences.append(
            f"{name}: the gates {'only fall' if falls else 'DO NOT only fall'}, to "
            f"{row['wavelet_end'] / row['wavelet_start']:.3f} (wavelet) and "
            f"{row['fourier_end'] / row['fourier_start']:.3f} (Fourier) of their start."
        )
    better, worse, open_ = [], [], []
    for name, row in rows.items():
        if name == "none":
            continue
        clear = abs(row["gain"]) > CLEAR * row["gain_error"]
        (open_ if not clear else better if row["gain"] > 0 else worse).append(name)
    for names, verdict in (
        (better, "better than no spectral loss"),
        (worse, "worse than no spectral loss"),
        (open_, f"within {CLEAR:g} standard errors of no spectral loss"),
    ):
        if names:
            sentences.append(f"{verdict}: {', '.join(names)}.")
    best = max(rows, key=lambda name: rows[name]["psnr"])
    sentences.append(f"Highest PSNR: {best}, {rows[best]['psnr']:.2f} dB.")
    return "\n".join(sentences)


def page(stored) -> str:
    """The page in docs/results below the docstring, from a frequency_gates.json."""
    heads = ("gate, most", "PSNR", "±", "gain", "s.e.")
    digits = {"psnr": 2, "psnr_deviation": 2, "gain": 2, "gain_error": 2}
    for loss in ("wavelet", "fourier"):
        heads += (f"{loss} half-way", "at the end")
        digits |= {f"{loss}_mid": 4, f"{loss}_end": 4}
    rows = [
        [name, *(markdown.number(row[key], n) for key, n in digits.items())]
        for name, row in stored["rows"].items()
    ]
    return f"{markdown.table(heads, rows)}\n\n{markdown.bullets(stored['said'])}"


def draw_figure(fitted: dict[GateSetting, Fitted], path: pathlib.Path) -> None:
    """For each weight: the wavelet gate and the PSNR against the step."""
    from nerfies_jax.capture.json_files import replaced_file
    from nerfies_jax.evaluation import figures

    weights = sorted({arm.most for arm in fitted if arm.most is not None})
    size = 10, 1 + 3 * len(weights)
    figure = figures.new_figure(figsize=size, dpi=120, layout="constrained")
    axes = figure.subplots(len(weights), 2, squeeze=False)
    colors = dict(
        zip(RULES, [f"C{i}" for i in range(len(RULES))], strict=True), none="0.4"
    )
    for (gates, quality), most in zip(axes, weights, strict=True):
        for arm, fits in fitted.items():
            if arm.most not in (None, most):
                continue
            step = np.arange(fits.psnr.shape[1])
            style = dict(
                color=colors[arm.rule],
                label=arm.rule,
                linestyle="--" if arm.rule in WARNINGS else "-",
            )
            if fits.opening is not None:
                gates.plot(step, fits.opening[:, 0].mean(0), **style)
            quality.plot(step, fits.psnr.mean(0), **style)
            edges = fits.psnr.min(0), fits.psnr.max(0)
            quality.fill_between(
                step, *edges, color=style["color"], alpha=0.12, linewidth=0
            )
        gates.set(ylabel=f"wavelet weight / {most:g}", ylim=(0, 1))
        # The first steps would take half of the axis.
        lowest = min(x.psnr[:, len(step) // 20 :].min() for x in fitted.values())
        quality.set(ylabel="PSNR (dB), mean and range of seeds")
        quality.set_ylim(bottom=lowest)
        quality.legend(frameon=False, fontsize=8, ncols=2, loc="lower right")
        for each in (gates, quality):
            each.set_xlabel("step")
            each.grid(alpha=0.3)
            each.spines[["top", "right"]].set_visible(False)
    with replaced_file(path) as partial:
        figure.savefig(partial)


@cli.command(FrequencyGates)
def main(args):
    """Run the job of the command line; exit code 2 where its input is wrong."""
    with cli.user_errors():
        if args.out is not None:
            args.out.mkdir(parents=True, exist_ok=True)
        platform.start_jax(args.device)
    fitted = {}
    for arm in arms(args):
        fitted[arm] = fit(arm, args)
        console.say(f"{arm.name}: {fitted[arm].psnr[:, -1].mean():.2f} dB")
    console.say()
    rows = numbers(fitted)
    console.say(table(rows))
    console.say()
    console.say(format_conclusions(rows))
    from nerfies_jax.capture.json_files import write_json
    from nerfies_jax.measure import clock

    record = {
        "settings": asked.without_places(args),
        "machine": clock.machine(),
        "rows": rows,
        "said": format_conclusions(rows).split("\n"),
    }
    if args.out is not None:
        write_json(args.out / "frequency_gates.json", record)
        draw_figure(fitted, args.out / "frequency_gates.png")
        console.say(args.out / "frequency_gates.png")
    return record


if __name__ == "__main__":
    main()
