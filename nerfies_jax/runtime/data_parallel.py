"""Equal shares of one step, computed in sequence or on one device each."""

import functools
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

PyTree = Any

AXIS = "shares"


def device_count(shares: int) -> int:
    """Return the number of this process's devices that equal shares of a step can use.

    A CPU is one device unless `jax_num_cpu_devices` is larger.

    Args:
      shares: Number of shares.

    Returns:
      The largest divisor of `shares` that is at most the number of devices.
    """
    most = min(shares, jax.local_device_count())
    return next(count for count in range(most, 0, -1) if shares % count == 0)


def on_devices(
    work: Callable[..., PyTree], shares: int, devices: int, *inputs: PyTree
) -> PyTree:
    """Compute all shares of a step, on one or more devices.

    On one device they are computed in sequence, on several each device computes an
    equal number. Results equal those of one device to rounding. For 10,000 Gaussians at
    256x192 on two cores, two views with their gradients take 37 ms, one takes 32.

    Args:
      work: Function `work(i, *inputs)` of the index of a share.
      shares: Number of shares.
      devices: Number of devices, a divisor of `shares`.
      *inputs: Arrays, replicated to all devices.

    Returns:
      Results stacked along a new first axis.
    """
    number = jnp.arange(shares, dtype=jnp.int32)  # as steps are, also where x64 is on
    if devices == 1:
        return lax.map(lambda share: work(share, *inputs), number)
    each = shares // devices

    def own(first, *inputs):
        return lax.map(lambda i: work(first[0] + i, *inputs), number[:each])

    spread = jax.shard_map(
        own,
        mesh=_mesh(devices),
        in_specs=(PartitionSpec(AXIS), *(PartitionSpec() for _ in inputs)),
        out_specs=PartitionSpec(AXIS),
        # JAX does not track the results of a `while_loop`.
        check_vma=False,
    )
    return spread(number[::each], *inputs)


def rows_on_devices(
    work: Callable[..., PyTree],
    fixed: Hashable,
    rows: PyTree,
    program: Callable[[PyTree], PyTree] | None = None,
) -> Iterator[PyTree]:
    """Map a function over rows, one row at a time on each of this process's devices.

    All rows use one program, which is compiled once for `work` and `fixed`.

    Args:
      work: Function `work(fixed, *row)`.
      fixed: Static argument.
      rows: Tuple of pytrees whose leaves have the rows along their first axis.
      program: The program compiled from `lower_rows`. None to compile it here.

    Yields:
      The result for each row as NumPy arrays, in order.
    """
    count = len(jax.tree.leaves(rows)[0])
    devices = _devices_of(count)
    program = program or functools.partial(_one_each, work, fixed, devices)
    for start in range(0, count, devices):
        # The last rows again where fewer are left than there are devices.
        chosen = np.minimum(np.arange(start, start + devices), count - 1)
        few = jax.tree.map(lambda leaf, chosen=chosen: np.asarray(leaf)[chosen], rows)
        done = jax.device_get(program(few))
        for share in range(min(devices, count - start)):
            yield jax.tree.map(lambda leaf, share=share: leaf[share], done)


def lower_rows(
    work: Callable[..., PyTree], fixed: Hashable, rows: PyTree
) -> jax.stages.Lowered:
    """Lower the program of `rows_on_devices`, to be compiled.

    Args:
      work: Function `work(fixed, *row)`.
      fixed: Static argument.
      rows: Tuple of pytrees of arrays or of their shapes.

    Returns:
      The lowered program.
    """
    devices = _devices_of(len(jax.tree.leaves(rows)[0]))
    few = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((devices, *leaf.shape[1:]), leaf.dtype), rows
    )
    return _one_each.lower(work, fixed, devices, few)


def _devices_of(count):
    return min(jax.local_device_count(), max(count, 1))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _one_each(work, fixed, devices, rows):
    def one(share, rows):
        return work(fixed, *jax.tree.map(lambda leaf: leaf[share], rows))

    return on_devices(one, devices, devices, rows)


def shared(tree: PyTree, devices: int) -> PyTree:
    """Replicate arrays that no program overwrites, without a copy on the first device.

    Args:
      tree: A pytree of arrays.
      devices: Number of devices.

    Returns:
      The pytree on each of the first `devices` devices.
    """
    if devices == 1:
        return tree
    mesh = _mesh(devices)
    sharding = NamedSharding(mesh, PartitionSpec())

    def whole(leaf):
        copies = [jax.device_put(leaf, device) for device in mesh.devices]
        return jax.make_array_from_single_device_arrays(leaf.shape, sharding, copies)

    return jax.tree.map(whole, tree)


def replicate(tree: PyTree, devices: int) -> PyTree:
    """Copy arrays to several devices.

    Args:
      tree: A pytree of arrays.
      devices: Number of devices.

    Returns:
      The pytree on each of the first `devices` devices.
    """
    if devices == 1:
        return tree
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec()))


def first_copy(tree: PyTree, devices: int) -> PyTree:
    """Return the part of replicated arrays on the first device.

    It is not a copy, which would keep the mesh in its type, so that everything compiled
    for the earlier state, such as events and images, would be compiled again.

    Args:
      tree: A pytree from `replicate`.
      devices: Number of devices.

    Returns:
      The pytree on the first device.
    """
    if devices == 1:
        return tree
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def _mesh(devices):
    return Mesh(np.array(jax.local_devices()[:devices]), (AXIS,))
