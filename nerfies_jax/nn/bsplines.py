"""B-splines on evenly spaced knots, in closed form.

They are the basis functions B_i of Liu et al. 2024 (KAN), arXiv:2404.19756, section 2.2
(equation 2.12), and B_i,3 of Sonata, equation 4. Neither paper prints a formula. The
code of KAN (KindXiaoming/pykan) uses the Cox-de Boor recursion and moves the knots with
the inputs. Here the closed form is used, and knots are uniform and fixed (`nn.kan`).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def cubic(distance: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Evaluate the cubic B-spline with knots at whole numbers.

    This is the Cox-de Boor recursion of order 3 in closed form: 2/3 at 0, 1/6 at ±1,
    and zero from ±2 on with zero first and second derivatives. It is twice
    differentiable everywhere.

    Forward and backward pass of one KAN layer on one core: 8192 x 64 -> 64 with eight
    kernels takes 46 ms with Gaussians, 30 with this form, and 397 with the recursion
    over a tensor of all bases. 10,000 x 32 -> 32 with five kernels takes 16, 12 and
    131.

    Args:
      distance: Distance from the middle knot in units of the knot spacing, [...].

    Returns:
      Values in [0, 2/3], [...].
    """
    size = jnp.abs(distance)
    inside = size < 1
    # Written as x²|x|, because autodiff of |x|³ has no second derivative at 0.
    near = jnp.where(inside, distance, 0)
    middle = 2 / 3 - near**2 + near**2 * jnp.abs(near) / 2
    # Zero beyond 2, with a finite gradient also where the distance is infinite.
    remainder = jnp.maximum(2 - size, 0)
    return jnp.where(inside, middle, remainder**3 / 6)
