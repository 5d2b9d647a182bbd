"""Data parallelism: equal shares of a step, in sequence or one on each device."""

import contextlib
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

_limit: int | None = None  # of `limit_devices`
_spanning = False  # in `spanning_hosts`


def limit_devices(count: int | None) -> None:
    """Limit the number of devices that this process computes on.

    Args:
      count: Number of devices. None for all.

    Raises:
      ValueError: If there are fewer.
    """
    global _limit
    present = jax.local_device_count()
    if count is not None and not 1 <= count <= present:
        kind = jax.local_devices()[0].platform
        raise ValueError(
            f"devices={count}: this process has {present} of kind {kind}; choose 1 to "
            f"{present}"
        )
    _limit = count


def available() -> int:
    """Return the number of local devices, within the limit of `limit_devices`."""
    return jax.local_device_count() if _limit is None else _limit


@contextlib.contextmanager
def spanning_hosts() -> Iterator[None]:
    """Let models that are built and trained in the block use the devices of all hosts.

    All processes must run the same steps in the same order (`runtime.hosts`). Other
    programs, such as those of `rows_on_devices`, stay on the devices of this process.

    Yields:
      None.
    """
    global _spanning
    before, _spanning = _spanning, True
    try:
        yield
    finally:
        _spanning = before


def spans_hosts() -> bool:
    """Test if models use the devices of all hosts.

    Returns:
      True within `spanning_hosts`.
    """
    return _spanning


def check_hosts(shares: int, setting: str, *, divisible: bool = False) -> None:
    """Check that all processes get equal numbers of the shares of a step.

    Args:
      shares: Number of shares.
      setting: Name of the setting of this number, empty if there is none.
      divisible: Whether a single share can be divided further.

    Raises:
      ValueError: If they do not.
    """
    processes = jax.process_count()
    if divisible and shares == 1:
        return
    if shares % processes:
        remedy = f"set {setting} to a multiple of {processes}, or " if setting else ""
        raise ValueError(
            f"a step has {shares} equal part(s), which {processes} processes cannot "
            f"share evenly; {remedy}start fewer processes"
        )


def idle_note(used: int, shares: int, setting: str) -> list[str]:
    """Describe the devices that a training step does not use, with a way to use them.

    Args:
      used: Number of devices that a step uses.
      shares: Number of its equal shares.
      setting: Name of the setting of this number, empty if there is none.

    Returns:
      One line, or none if every device is used.
    """
    present = available()
    if used >= present:
        return []
    line = f"{used} of {present} devices train, and {present - used} stay idle"
    if setting:
        line += (
            f": a step has {shares} equal part(s); set {setting} to a multiple of "
            f"{present} to use them all"
        )
    return [line]


def device_count(shares: int, *, divisible: bool = False) -> int:
    """Return the number of devices that equal shares of a step can use.

    A CPU is one device unless `jax_num_cpu_devices` is larger. `limit_devices` may
    exclude some. They are local devices, or within `spanning_hosts` equal numbers of
    each process.

    Args:
      shares: Number of shares.
      divisible: Whether a single share can be divided further, among any number of
        devices. It is if `limit_devices` has set this number, or within
        `spanning_hosts`: two CPU cores divide the image of a step of splats in 0.85 to
        0.98 of the time, but take 1.8 times the processor time.

    Returns:
      The largest divisor of `shares` that is at most the number of devices, or all
      devices for a single share that is divided.

    Raises:
      ValueError: If the processes of `spanning_hosts` cannot have equal numbers.
    """
    processes = jax.process_count() if _spanning else 1
    if divisible and shares == 1 and (_spanning or _limit is not None):
        return processes * available()
    if _spanning:
        check_hosts(shares, "")
    return processes * _largest_divisor(shares // processes)


def _largest_divisor(shares):
    most = min(shares, available())
    return next(count for count in range(most, 0, -1) if shares % count == 0)


def on_devices(
    work: Callable[..., PyTree], shares: int, devices: int, *inputs: PyTree
) -> PyTree:
    """Compute all shares of a step, on one or more devices.

    On one device they are computed in sequence. On several devices, each computes an
    equal number of shares. Results are the same up to rounding. On two cores, two views
    of 10,000 Gaussians at 256x192 and their gradients take 37 ms, and one takes 32 ms.

    Args:
      work: Function `work(i, *inputs)` of the index of a share.
      shares: Number of shares.
      devices: Number of devices, a divisor of `shares`.
      *inputs: Arrays, replicated to all devices.

    Returns:
      Results stacked along a new first axis.
    """
    mesh = None if devices == 1 else _mesh(devices)
    return _on_mesh(work, shares, mesh, *inputs)


def assembled(work: Callable[..., PyTree], devices: int, *inputs: PyTree) -> PyTree:
    """Compute one part of a result on each device, and copy all parts to all devices.

    It can be differentiated in reverse mode. What follows it in a program is computed
    on every device, as what precedes it.

    Args:
      work: Function `work(i, *inputs)` of the index of a part.
      devices: Number of devices and parts, at least 2.
      *inputs: Arrays, replicated to all devices.

    Returns:
      Results stacked along a new first axis.
    """
    parts = on_devices(work, devices, devices, *inputs)
    return lax.with_sharding_constraint(
        parts, NamedSharding(_mesh(devices), PartitionSpec())
    )


def _on_mesh(work, shares, mesh, *inputs):
    indices = jnp.arange(shares, dtype=jnp.int32)  # the dtype of steps, even with x64
    if mesh is None:
        return lax.map(lambda share: work(share, *inputs), indices)
    per_device = shares // mesh.size

    def on_device(first, *inputs):
        return lax.map(lambda i: work(first[0] + i, *inputs), indices[:per_device])

    program = jax.shard_map(
        on_device,
        mesh=mesh,
        in_specs=(PartitionSpec(AXIS), *(PartitionSpec() for _ in inputs)),
        out_specs=PartitionSpec(AXIS),
        check_vma=False,  # not supported for results of a `while_loop`
    )
    return program(indices[::per_device], *inputs)


def rows_on_devices(
    work: Callable[..., PyTree],
    fixed: Hashable,
    rows: PyTree,
    program: Callable[[PyTree], PyTree] | None = None,
) -> Iterator[PyTree]:
    """Map a function over rows, one row at a time on each local device.

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
        # If fewer rows than devices remain, the last row is repeated.
        batch = np.minimum(np.arange(start, start + devices), count - 1)
        inputs = jax.tree.map(lambda leaf, batch=batch: np.asarray(leaf)[batch], rows)
        results = jax.device_get(program(inputs))
        for share in range(min(devices, count - start)):
            yield jax.tree.map(lambda leaf, share=share: leaf[share], results)


def lower_rows(
    work: Callable[..., PyTree], fixed: Hashable, rows: PyTree
) -> jax.stages.Lowered:
    """Lower the program of `rows_on_devices`, for compilation.

    Args:
      work: Function `work(fixed, *row)`.
      fixed: Static argument.
      rows: Tuple of pytrees of arrays or of their shapes.

    Returns:
      The lowered program.
    """
    devices = _devices_of(len(jax.tree.leaves(rows)[0]))
    shapes = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((devices, *leaf.shape[1:]), leaf.dtype), rows
    )
    return _one_each.lower(work, fixed, devices, shapes)


def _devices_of(count):
    return min(available(), max(count, 1))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _one_each(work, static, devices, rows):
    def work_on_row(share, rows):
        return work(static, *jax.tree.map(lambda leaf: leaf[share], rows))

    mesh = None if devices == 1 else _local_mesh(devices)
    return _on_mesh(work_on_row, devices, mesh, rows)


def shared(tree: PyTree, devices: int) -> PyTree:
    """Replicate arrays without a copy on the first device, or on any CPU device.

    Args:
      tree: A pytree of arrays of numbers, which must never be donated to a program.
      devices: Number of devices.

    Returns:
      The pytree on each of the first `devices` devices.
    """
    if devices == 1:
        return tree
    if jax.local_devices()[0].platform == "cpu":
        tree = jax.tree.map(np.asarray, tree)  # memory that all CPU devices use
    return _on_each(tree, devices)


def _on_each(tree, devices):
    """Replicate arrays, which does not compare those of several processes."""
    mesh = _mesh(devices)
    sharding = NamedSharding(mesh, PartitionSpec())

    def replicate_leaf(leaf):
        copies = [jax.device_put(leaf, device) for device in mesh.local_devices]
        return jax.make_array_from_single_device_arrays(leaf.shape, sharding, copies)

    return jax.tree.map(replicate_leaf, tree)


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
    if _spanning:  # `device_put` would compare the arrays of all processes
        return _on_each(tree, devices)
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec()))


def first_copy(tree: PyTree, devices: int) -> PyTree:
    """Return the part of replicated arrays that is on the first device.

    The result is not sharded over a mesh. Programs that were compiled for the state
    before it was replicated, such as events and the renderer, need no recompilation.

    Args:
      tree: A pytree from `replicate`.
      devices: Number of devices.

    Returns:
      The pytree on the first device.
    """
    if devices == 1:
        return tree
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def uncommitted(tree: PyTree) -> PyTree:
    """Return arrays that are not bound to a device, like those of an initial state.

    A program of arrays that are bound to one of several devices has another key in the
    compilation cache.

    Args:
      tree: A pytree of arrays on the first device, such as a trained state.

    Returns:
      The pytree with copies of the arrays. PRNG keys stay as they are.
    """

    def copy_leaf(leaf):
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        if is_key or not isinstance(leaf, jax.Array) or not leaf.committed:
            return leaf
        return jax.device_put(np.array(leaf, copy=True), may_alias=False)

    return jax.tree.map(copy_leaf, tree)


def _mesh(devices):
    """Return the mesh of a step: local devices, or equal numbers of each process."""
    if not _spanning:
        return _local_mesh(devices)
    each = devices // jax.process_count()
    of_process = [jax.local_devices(i)[:each] for i in range(jax.process_count())]
    return Mesh(np.array(of_process).ravel(), (AXIS,))


def _local_mesh(devices):
    return Mesh(np.array(jax.local_devices()[:devices]), (AXIS,))
