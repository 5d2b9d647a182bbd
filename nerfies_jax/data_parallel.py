"""Equal shares of one step, one after the other or on a device each."""

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
    """How many of this process's devices `shares` equal shares of a step can use.

    The largest divisor of their number that is no more than there are devices. A CPU is
    one device unless `jax_num_cpu_devices` says more.
    """
    most = min(shares, jax.local_device_count())
    return next(count for count in range(most, 0, -1) if shares % count == 0)


def on_devices(
    work: Callable[..., PyTree], shares: int, devices: int, *inputs: PyTree
) -> PyTree:
    """`work(i, *inputs)` for i from 0 to `shares` - 1, stacked along a first axis.

    On one device one after the other, on several a share of them on each; the results
    are those of one device to rounding. `devices` divides `shares`. 10,000 Gaussians,
    256x192, two cores: two views with their gradients in 37 ms, one in 32.
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
        # What leaves a `while_loop` is not followed.
        check_vma=False,
    )
    return spread(number[::each], *inputs)


def rows_on_devices(
    work: Callable[..., PyTree],
    fixed: Hashable,
    rows: PyTree,
    program: Callable[[PyTree], PyTree] | None = None,
) -> Iterator[PyTree]:
    """`work(fixed, *row)` for each row of the leaves of a tuple, as NumPy, in order.

    One row at a time on each of this process's devices, all by one program, which is
    compiled once for a `work` and what is `fixed`, or was: what `lower_rows` gave.
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
    """The program of `rows_on_devices` for rows of such shapes, to be compiled."""
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
    """`replicate` of what no program overwrites: the first device's is no copy."""
    if devices == 1:
        return tree
    mesh = _mesh(devices)
    sharding = NamedSharding(mesh, PartitionSpec())

    def whole(leaf):
        copies = [jax.device_put(leaf, device) for device in mesh.devices]
        return jax.make_array_from_single_device_arrays(leaf.shape, sharding, copies)

    return jax.tree.map(whole, tree)


def replicate(tree: PyTree, devices: int) -> PyTree:
    """The arrays, whole on each of the first `devices` devices."""
    if devices == 1:
        return tree
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec()))


def first_copy(tree: PyTree, devices: int) -> PyTree:
    """What `replicate` gave, on the first device alone.

    Its part there, not a copy: that would keep the mesh in its type, and everything
    compiled for the state before, events and pictures, would be compiled again.
    """
    if devices == 1:
        return tree
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def _mesh(devices):
    return Mesh(np.array(jax.local_devices()[:devices]), (AXIS,))
