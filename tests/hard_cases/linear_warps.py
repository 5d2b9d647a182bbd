"""Warps whose Jacobian is known, and what the elastic penalty makes of it.

Every point x moves by D x, with D nothing, tiny, singular, folded or huge.
"""

import jax
import jax.numpy as jnp
import numpy as np

SHEAR = np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
DISPLACEMENTS = {
    "nothing": np.zeros((3, 3)),
    "a shear of 1e-7": 1e-7 * SHEAR,
    "a stretch of 1e-4": np.diag([1e-4, 0.0, 0.0]),
    "equal stretches": np.diag([1.0, 1.0, 1.0]),
    "a plane": np.diag([-1.0, 0.0, 0.0]),
    "a line": np.diag([-1.0, -1.0, 0.0]),
    "a point": np.diag([-1.0, -1.0, -1.0]),
    "a mirror": np.diag([-2.0, 0.0, 0.0]),
    "a point mirror": np.diag([-2.0, -2.0, -2.0]),
    "a half turn": np.diag([-2.0, -2.0, 0.0]),
    "a fold by a little": np.diag([-1.001, 0.0, 0.0]),
    "huge": 1e4 * (SHEAR + np.diag([1.0, -2.0, 3.0])),
}


def linear_warp(params, displacement):
    """Parameters under which every point x moves by `displacement` @ x.

    `params` has the shapes and dtypes; their values do not matter.

    Three hidden units carry x + 16, which is positive, and the others rest; the
    read-out takes 16 off again.
    """
    hidden = []
    for layer in params.hidden:
        weight = np.zeros(layer.weight.shape)
        weight[:3, :3] = np.eye(3)
        hidden.append(weight)
    offsets = [np.full(layer.bias.shape, -1.0) for layer in params.hidden]
    offsets[0][:3] = 16
    offsets[1][:3] = 0
    angular, linear = (params.heads[name] for name in ("angular", "linear"))
    weight = np.zeros(linear.weight.shape)
    weight[:3] = displacement.T
    heads = {
        "angular": jax.tree.map(lambda leaf: np.zeros(leaf.shape), angular),
        "linear": linear._replace(weight=weight, bias=-16 * displacement.sum(1)),
    }
    layers = [
        layer._replace(weight=weight, bias=offset)
        for layer, weight, offset in zip(params.hidden, hidden, offsets, strict=True)
    ]
    warp_params = params._replace(hidden=tuple(layers), heads=heads)
    return jax.tree.map(
        lambda new, old: jnp.asarray(new, old.dtype), warp_params, params
    )


def cost(spec, displacement):
    """The penalty of one sample in NumPy, from the singular values."""
    jacobian = np.eye(3) + displacement
    stretches = np.linalg.svd(jacobian, compute_uv=False)
    volume = np.linalg.det(jacobian)
    stretches[2] *= np.sign(volume) or 1
    # log σ, and its tangent below 1e-2
    logs = np.log(np.maximum(stretches, 1e-2)) + np.minimum(stretches / 1e-2 - 1, 0)
    energy = np.sum(logs**2) / (4 * spec.robust_width**2)
    factor = 2 * spec.robust_width if spec.scaling == "official" else 2
    robust = factor * energy / (1 + energy)
    return robust + spec.fold_cost * max(0.0, -volume)
