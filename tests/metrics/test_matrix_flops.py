"""Operations of matrix products, counted right."""

import jax
import jax.numpy as jnp
import numpy as np

from nerfies_jax.nn import dense
from nerfies_jax.training import matrix_flops


def product(x, y):
    return x @ y


def ones(*shape):
    return np.ones(shape, np.float32)


LEFT, RIGHT = ones(3, 4), ones(4, 5)


def test_a_matrix_product_has_two_operations_a_multiply_add():
    counted = matrix_flops.count(product, LEFT, RIGHT)
    assert counted == matrix_flops.Counted(2 * 3 * 4 * 5, False)
    batched = matrix_flops.count(jax.vmap(product), ones(7, 3, 4), ones(7, 4, 5))
    assert batched.flops == 7 * counted.flops
    # A vector under vmap is a matrix; what is alike for the batch is computed once.
    row = matrix_flops.count(jax.vmap(product, (0, None)), LEFT, RIGHT)
    assert row.flops == counted.flops
    assert (
        matrix_flops.count(dense.product, *map(jnp.asarray, (LEFT, RIGHT))) == counted
    )


def test_a_gradient_has_a_product_for_each_side():
    def total(x, y):
        return jnp.sum(product(x, y))

    both = matrix_flops.count(jax.grad(total, (0, 1)), LEFT, RIGHT)
    one = matrix_flops.count(jax.grad(total), LEFT, RIGHT)
    # The value itself is read by nobody
    assert (both.flops, one.flops) == (2 * 120, 120)


def test_every_round_of_a_loop_counts_and_of_branches_the_dearest():
    def rounds(x):
        return jax.lax.map(lambda row: jnp.tanh(row @ RIGHT), x, batch_size=2)

    assert matrix_flops.count(rounds, ones(6, 4)) == (2 * 6 * 4 * 5, False)

    def either(x):
        return jax.lax.cond(
            x[0, 0] > 0, lambda x: x @ RIGHT, lambda x: (x @ RIGHT) @ RIGHT.T @ RIGHT, x
        )

    assert matrix_flops.count(either, LEFT) == (3 * 120, False)


def test_a_loop_whose_rounds_nobody_knows_counts_once_and_says_so():
    def until(x):
        return jax.lax.while_loop(lambda x: x[0, 0] < 9, lambda x: x @ ones(4, 4), x)

    assert matrix_flops.count(until, LEFT) == (2 * 3 * 4 * 4, True)
    # Without products there is nothing more to count
    loose = matrix_flops.count(
        lambda x: jax.lax.while_loop(lambda x: x < 9, lambda x: 2 * x, x), 1.0
    )
    assert loose == (0, False)
