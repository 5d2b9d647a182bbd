"""Encodings, networks, spectra, losses and schedules: the laws they are used for.

Bounds count roundings; `eps` times the number of terms of a sum, times their size.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gaussians_jax import harmonics
from gaussians_jax.effects import depth as depths
from gaussians_jax.effects import neighbours, spectral
from gaussians_jax.splats import Params, Splats
from nerfies_jax.nets import encoding
from nerfies_jax.nets.encoding import EncodingSpec
from tests.hard_cases import properties
from tests.hard_cases.properties import cast, close, compiled, eps, norm, same

pytestmark = [pytest.mark.hard_cases, pytest.mark.full]
BANDS = 6
TIMES_PI = EncodingSpec(BANDS, identity=False, times_pi=True)
encode = compiled(lambda x, window: encoding.encode(TIMES_PI, x, window))
anneal = compiled(lambda alpha: encoding.anneal(BANDS, alpha))


@given(
    steps=st.lists(st.integers(-4096, 4096), min_size=3, max_size=3),
    turns=st.integers(-8, 8),
)
def test_bands_are_periodic_odd_and_even_to_the_bit(steps, turns, dtype):
    """At multiples of 2^-12, where adding whole periods does not round."""
    x = np.array(steps) / 4096
    inputs = cast(dtype, x, x + 2 * turns, -x)
    window = np.ones(BANDS, dtype)
    here, later, mirrored = (encode(point, window) for point in inputs)
    same(here, later)
    here, mirrored = (
        np.asarray(x, np.float64).reshape(BANDS, 2, 3) for x in (here, mirrored)
    )
    same(mirrored, here * np.array([-1, 1])[:, None])
    close(np.sum(here**2, axis=1), np.ones((BANDS, 3)), 8 * eps(dtype))
    # the double angle: each band follows from the one before it
    sine, cosine = here[:, 0], here[:, 1]
    close(sine[1:], (2 * sine * cosine)[:-1], 8 * eps(dtype))
    close(cosine[1:], (cosine**2 - sine**2)[:-1], 8 * eps(dtype))


split = compiled(lambda image: spectral.haar_pyramid(image, 3))


@pytest.mark.parametrize("shape", [(7, 5), (1, 6)])
@given(data=st.data(), share=properties.numbers(-2, 2))
def test_a_wavelet_pyramid_is_orthonormal_and_linear(shape, data, share, dtype):
    one, other = (data.draw(properties.pictures(*shape, 1)) for _ in range(2))
    one, other = cast(dtype, one, other)
    joint = one + one.dtype.type(share) * other
    pyramids = [split(image) for image in (one, other, joint)]
    parts = [jax.tree.leaves(cast("float64", pyramid)) for pyramid in pyramids]
    for a, b, joint in zip(*parts, strict=True):
        # three levels of sums of four, each level doubling what a constant adds
        close(joint, a + share * b, 3 * 8 * 4 * eps(dtype))
    whole = np.asarray(one, np.float64)
    for bands in pyramids[0].high:  # odd sides are extended, level by level
        odd = [(0, n % 2) for n in whole.shape[:2]]
        whole = np.pad(whole, [*odd, (0, 0)], mode="edge")
        low = (
            whole[::2, ::2] + whole[::2, 1::2] + whole[1::2, ::2] + whole[1::2, 1::2]
        ) / 2
        high = sum(np.sum(np.asarray(band, np.float64) ** 2) for band in bands)
        energy = np.sum(whole**2)
        close(high + np.sum(low**2), energy, 64 * eps(dtype) * energy)
        whole = low


@compiled
def spectra(image, truth):
    return (
        spectral.amplitudes(image),
        spectral.amplitudes(jnp.roll(image, (2, 3), axis=(0, 1))),
        spectral.fourier_loss(spectral.FourierSpec(), image, truth),
        spectral.fourier_loss(spectral.FourierSpec(), truth, image),
        spectral.wavelet_loss(spectral.WaveletSpec(), image, truth),
        spectral.wavelet_loss(spectral.WaveletSpec(), truth, image),
        spectral.fourier_loss(spectral.FourierSpec(), truth, truth),
        spectral.wavelet_loss(spectral.WaveletSpec(), truth, truth),
    )


@given(image=properties.pictures(), truth=properties.pictures())
def test_spectra_keep_energy_and_their_losses_are_symmetric(image, truth, dtype):
    image, truth = cast(dtype, image, truth)
    size, shifted, *both, nothing, no_wavelet = spectra(image, truth)
    size = np.asarray(size, np.float64)
    width = image.shape[1]
    twice = [1 if k in (0, width / 2) else 2 for k in range(width // 2 + 1)]
    energy = np.sum(np.asarray(image, np.float64) ** 2)
    found = np.sum(size**2 * np.array(twice)[:, None])
    close(found, energy, 32 * eps(dtype) * energy)  # Parseval
    largest = math.sqrt(energy)
    close(shifted, size, 32 * eps(dtype) * largest)
    for here, there in (both[:2], both[2:]):
        assert here >= 0
        close(here, there, 32 * eps(dtype) * float(here))
    assert nothing == 0
    assert no_wavelet == 0


PIXELS = 12


@compiled
def depth_losses(depth, truth, known, scale, offset):
    affine = scale * depth + offset
    return {
        name: (
            form(depth, truth, known),
            form(affine, truth, known),
            form(truth, truth, known),
        )
        for name, form in depths.FORMS.items()
    } | {"scaled": depths.metric(scale * depth, scale * truth, known)}


@given(
    depth=properties.many(PIXELS, 1, 10),
    truth=properties.many(PIXELS, 1, 10),
    known=properties.many(PIXELS, 0, 1),
    scale=properties.numbers(-3, 3).map(lambda e: 10**e),
    offset=properties.numbers(0, 5),
)
def test_relative_depth_losses_do_not_see_scale_and_offset(
    depth, truth, known, scale, offset, dtype
):
    """Unless the depths count as flat, deviating by under 1e-3 of their middle.

    There, by design, they are divided by that much, and an offset raises the middle.
    """
    known = known < 0.7
    offset = offset * scale
    if known.sum() > 1:
        spread = min(
            np.abs(x[known] - f(x[known])).mean()
            for x in (depth, truth)
            for f in (np.mean, np.median)
        )
        lower = np.sort(depth[known])[(known.sum() - 1) // 2]
        spread = min(spread, np.abs(depth[known] - lower).mean())
        assume(spread > 0.1)
    depth, truth, scale, offset = cast(
        dtype, depth, truth, np.array(scale), np.array(offset)
    )
    found = depth_losses(depth, truth, known, scale, offset)
    # depths of up to 15 over a deviation of at least 0.1; squared for the correlation
    bound = 64 * eps(dtype) * (15 / 0.1) ** 2
    for name in ("affine", "correlation"):
        here, there, _ = found[name]
        close(there, here, bound)
    for name in depths.FORMS:
        here, _, nothing = found[name]
        assert here >= 0, name
        assert nothing == 0, name
    assert found["correlation"][0] <= 2 + bound
    # errors of up to 9 over a mean of at least 1
    close(found["scaled"], found["metric"][0], 32 * 10 * eps(dtype))


def splats_at(mean, inactive):
    count = len(mean)
    rows = Splats(
        mean=mean,
        log_scale=np.zeros((count, 3)),
        quaternion=np.ones((count, 4)),
        opacity_logit=np.where(inactive, -1000, 0),
        sh_dc=np.zeros((count, 1, 3)),
        sh_rest=np.zeros((count, 0, 3)),
    )
    return jax.tree.map(jnp.asarray, cast("float32", rows))


@given(
    mean=properties.many((12, 3), -1, 1),
    inactive=properties.many(12, 0, 1),
    motion=properties.motions(),
    scale=st.sampled_from([1.0, 2.0**-10, 1024.0]),
)
def test_neighbours_do_not_see_motion_nor_unit(mean, inactive, motion, scale):
    """The graph itself may name equally distant neighbours in either order."""
    spec = neighbours.NeighbourSpec(count=4)
    inactive = inactive < 0.3
    moved = scale * (mean @ motion.rotation.T + motion.translation)
    here, there = (
        neighbours.find(spec, Params({"splats": splats_at(x, inactive)}, {}), 1.0)
        for x in (mean, moved)
    )
    weight = np.asarray(here.weight)
    assert np.all((weight >= 0) & (weight <= 1))
    assert np.all(np.diff(weight, axis=1) <= 0)
    assert np.all(weight[inactive] == 0)
    assert not np.any(inactive[np.asarray(here.index)[weight > 0]])
    # float32 means of up to 12 round to 12 eps; a weight is gamma d² of its exponent,
    # with d = 0.03 at the median of the farthest, so 2 gamma d δ = 1.2 e2 of δ / d
    live = mean[~inactive].astype(np.float32).astype(np.float64)
    between = np.linalg.norm(live[:, None] - live, axis=-1)
    near = np.sort(between, axis=1)[:, 1:5]
    unit = np.median(near[:, -1]) if len(live) > 1 else 0.0
    assume(unit > 1e-2 and len(live) > 4)
    close(there.weight, weight, 32 * 12 * eps("float32") / unit)


@compiled
def harmonic_powers(direction):
    terms = jnp.stack(harmonics.basis(direction, 3))
    opposite = jnp.stack(harmonics.basis(-direction, 3))
    return terms, opposite


@given(direction=properties.directions())
def test_harmonics_of_a_degree_have_one_power_and_parity(direction, dtype):
    """Unsöld's theorem: their squares sum to (2 l + 1) / 4 π, in every direction."""
    terms, opposite = cast("float64", *harmonic_powers(cast(dtype, direction)))
    for degree in range(4):
        band = slice(degree**2, (degree + 1) ** 2)
        power = (2 * degree + 1) / (4 * math.pi)
        close(np.sum(terms[band] ** 2), power, 32 * eps(dtype) * power)
        same(opposite[band], (-1) ** degree * terms[band])


towards = compiled(harmonics.colour_towards)


@given(
    coefficients=properties.many((4, 3), -1, 1),
    mean=properties.vectors(),
    position=properties.vectors(),
    motion=properties.motions(),
)
def test_degree_one_turns_with_the_world(coefficients, mean, position, motion, dtype):
    """-y, z, -x are a vector's components, so its coefficients turn like a vector."""
    assume(norm(mean - position) > 1e-2)
    order, sign = [2, 0, 1], np.array([-1, -1, 1])[:, None]  # of x, y, z in the basis
    vector = coefficients[1:][order] * sign
    turned = coefficients.copy()
    turned[1:][order] = motion.rotation @ vector * sign
    moved = [motion.rotation @ x + motion.translation for x in (mean, position)]
    here = towards(*cast(dtype, coefficients, mean, position))
    there = towards(*cast(dtype, turned, *moved))
    # positions of up to 20 units round to 20 eps of what may be 1e-2 apart
    close(there, here, 16 * eps(dtype) * (1 + 20 / norm(mean - position)))
