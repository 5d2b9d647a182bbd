"""Trace-time checks of the arguments of public functions.

The jaxtyping annotations of a function are its contract. `checked` checks shapes, ranks
and dtypes of the arguments against them on every call, in Python. Under `jax.jit` this
happens only during tracing, and the compiled program is that of the undecorated
function. With `broadcast=True` a function of one item also accepts any number of
leading axes, which broadcast against each other as in NumPy.

NumPy arrays are converted to JAX arrays, and Python numbers are accepted as scalars.
Other arguments are refused with a `ValueError` that names the function, the argument,
its value and the expected shape and dtype.
"""

import functools
import inspect
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

CACHE_SIZE = 1000  # combinations of shapes per function that are not checked again
ANY = "_"  # an axis of any length
# Full scale of the integer images that are converted.
FULL_SCALE = {"uint8": 255.0, "uint16": 65535.0}


class _Leaf(NamedTuple):
    """One array argument, or one array field of a NamedTuple argument."""

    name: str
    kinds: frozenset[str]  # names of the allowed dtypes
    before: tuple[int | str, ...]  # axes before the variadic ones, or all axes
    variadic: str | None  # name of the variadic axes, None if there are none
    after: tuple[int | str, ...]  # axes after the variadic ones
    optional: bool
    host: bool  # stays a NumPy array
    number: bool  # the annotation allows Python numbers, which are not converted

    @property
    def core(self) -> tuple[int | str, ...]:
        return self.before + self.after


class _Record(NamedTuple):
    """An argument that is a NamedTuple of arrays."""

    name: str
    kind: type
    fields: tuple["_Leaf | _Record | None", ...]  # None for unchecked fields
    optional: bool


class _Plan(NamedTuple):
    title: str  # "so3.exp"
    names: tuple[str, ...]  # of all parameters, in order
    checks: tuple[tuple[str, _Leaf | _Record], ...]  # of the checked parameters


@typing.overload
def checked(function: F) -> F: ...
@typing.overload
def checked(
    *, broadcast: bool = False, images: Sequence[str] = ()
) -> Callable[[F], F]: ...
def checked(
    function: Any = None, *, broadcast: bool = False, images: Sequence[str] = ()
) -> Any:
    """Check the array arguments of a function against its annotations.

    Args:
      function: The function. Its arrays are annotated with jaxtyping types. Arguments
        with other annotations are not checked. NamedTuples are checked field by field.
      broadcast: True if the function takes one item and is to be mapped over leading
        axes with `jax.vmap`. Each array argument may have any number of them, and those
        of all arguments broadcast. Without any the function is called directly.
      images: Names of arguments that are images. uint8 and uint16 images are divided by
        255 and 65535. A gray image [height, width] gets a channel axis if the
        annotation has one.

    Returns:
      The function with checks of its arguments. They cost nothing under `jax.jit`.

    Raises:
      ValueError: When the function is called, if the rank, an axis or the dtype of an
        argument differs from its annotation, or if two axes of the same name differ in
        length.
    """
    if function is None:
        return functools.partial(checked, broadcast=broadcast, images=tuple(images))
    plan: _Plan | None = None
    valid: set[Any] = set()  # shapes and dtypes that need no check or conversion

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal plan
        if plan is None:  # at the first call, so that importing stays fast
            plan = _plan(function)
        positional = plan.names[: len(args)]
        if len(args) > len(positional) or not kwargs.keys().isdisjoint(positional):
            return function(*args, **kwargs)  # raises Python's own TypeError
        values = dict(zip(positional, args, strict=True)) | kwargs
        key = _key(plan, values)
        if key in valid:
            return function(*args, **kwargs)
        original = values
        if images:
            values = _with_float_images(plan, values, images)
        is_original = values is original
        sizes: dict[str, tuple[Any, str]] = {}
        batches: list[tuple[tuple[int, ...], str]] | None = [] if broadcast else None
        for name, check in plan.checks:
            if name in values:
                values[name] = _check(plan.title, check, values[name], sizes, batches)
        if batches and any(shape for shape, _ in batches):
            return _map(plan, function, batches, values, positional)
        if key is not None and is_original and len(valid) < CACHE_SIZE:
            valid.add(key)
        return _call(function, values, positional)

    return call


def _key(plan, values):
    """Shapes and dtypes of the arguments, or None if some are not JAX arrays."""
    key = []
    for name, _ in plan.checks:
        value = values.get(name)
        if value is not None:
            if not isinstance(value, jax.Array):
                return None
            key += (name, value.shape, value.dtype)
    return tuple(key)


def _plan(function: Callable[..., Any]) -> _Plan:
    parameters = inspect.signature(function).parameters
    checks = []
    for name, parameter in parameters.items():
        check = _read(name, parameter.annotation)
        if check is not None:
            checks.append((name, check))
    return _Plan(
        f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}",
        tuple(parameters),
        tuple(checks),
    )


@functools.cache
def _read(name: str, annotation: Any) -> _Leaf | _Record | None:
    """Return the check for an annotation, or None if it does not contain arrays."""
    options, optional = [annotation], False
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        options = list(typing.get_args(annotation))
        optional = type(None) in options
    arrays = [option for option in options if hasattr(option, "dim_str")]
    if arrays:
        host = all(option.array_type is np.ndarray for option in arrays)
        kinds = frozenset(kind for option in arrays for kind in option.dtypes)
        number = float in options or int in options
        return _leaf(name, kinds, arrays[0].dim_str, optional, host, number)
    records = [option for option in options if _is_record(option)]
    if len(records) != 1:
        return None
    hints = typing.get_type_hints(records[0])
    fields = tuple(_read(f"{name}.{key}", hints[key]) for key in records[0]._fields)
    return _Record(name, records[0], fields, optional)


def _is_record(option: Any) -> bool:
    return isinstance(option, type) and hasattr(option, "_fields")


def _leaf(
    name: str,
    kinds: frozenset[str],
    axes: str,
    optional: bool,
    host: bool,
    number: bool,
) -> _Leaf:
    before: list[int | str] = []
    after: list[int | str] = []
    variadic = None
    for axis in axes.split():
        if axis == "..." or axis.lstrip("#").startswith("*"):
            variadic = axis.lstrip("#*.")
            continue
        length = int(axis) if axis.isdigit() else axis if axis.isidentifier() else ANY
        (before if variadic is None else after).append(length)
    return _Leaf(
        name, kinds, tuple(before), variadic, tuple(after), optional, host, number
    )


def _check(title, check, value, sizes, batches):
    """Return the converted value, or raise ValueError."""
    if value is None and check.optional:
        return None
    if isinstance(check, _Record):
        if not isinstance(value, check.kind):
            raise ValueError(
                f"{title}: `{check.name}` must be a {check.kind.__name__}, got "
                f"{_description(value)}"
            )
        return check.kind(
            *(
                part if field is None else _check(title, field, part, sizes, batches)
                for field, part in zip(check.fields, value, strict=True)
            )
        )
    if check.number and isinstance(value, int | float):
        if batches is not None:
            batches.append(((), check.name))
        return value
    array = _as_array(title, check, value)
    _check_kind(title, check, array)
    _check_shape(title, check, array.shape, sizes, batches)
    return array


def _as_array(title, check, value):
    if isinstance(value, jax.Array):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return value if check.host else jnp.asarray(value)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and not check.core:
        return jnp.asarray(float(value) if "float32" in check.kinds else value)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return value
    raise ValueError(
        f"{title}: `{check.name}` must be an array, got {_description(value)}; convert "
        "it with jnp.asarray"
    )


def _check_kind(title, check, array):
    kind = array.dtype.name
    if kind in check.kinds or (
        "prng_key" in check.kinds and jnp.issubdtype(array.dtype, jax.dtypes.prng_key)
    ):
        return
    if "prng_key" in check.kinds:
        category, remedy = "a key", "create it with jax.random.key(seed)"
    elif "float32" in check.kinds:
        category, remedy = "floating-point", "cast it with .astype(jnp.float32)"
    elif "bool" in check.kinds:
        category, remedy = "boolean", "convert it with a comparison such as mask != 0"
    else:
        category, remedy = "integer", "cast it with .astype(jnp.int32)"
    raise ValueError(
        f"{title}: `{check.name}` must be {category}, got {kind}{list(array.shape)}; "
        f"{remedy}"
    )


def _check_shape(title, check, shape, sizes, batches):
    """Check a shape, and record named axes in `sizes` and leading axes in `batches`."""
    extra = len(shape) - len(check.core)
    front = len(check.before)
    if batches is None:
        fits = extra == 0 if check.variadic is None else extra >= 0
        lengths = shape[:front] + shape[len(shape) - len(check.after) :]
        if fits and check.variadic:
            middle = shape[front : front + extra]
            fits = sizes.setdefault(f"*{check.variadic}", (middle, check.name))[0] == (
                middle
            )
    else:
        fits = extra >= 0
        lengths = shape[max(extra, 0) :]
        batches.append((shape[: max(extra, 0)], check.name))
    if fits:
        for axis, length in zip(check.core, lengths, strict=True):
            if isinstance(axis, int):
                fits = fits and axis == length
            elif axis != ANY:
                fits = fits and sizes.setdefault(axis, (length, check.name))[0] == (
                    length
                )
    if not fits:
        raise ValueError(_shape_message(title, check, shape, sizes, batches))


def _shape_message(title, check, shape, sizes, batches):
    needs_name = batches is None and check.variadic
    middle = [f"*{check.variadic}" if needs_name else "..."]
    if batches is not None:
        axes = [*middle, *check.core]
    elif check.variadic is None:
        axes = [*check.before]
    else:
        axes = [*check.before, *middle, *check.after]
    message = (
        f"{title}: `{check.name}` has shape {list(shape)}, expected "
        f"[{', '.join(map(str, axes))}]"
    )
    named_axes = [
        f"{axis} = {_length(sizes[str(axis)][0])} from `{sizes[str(axis)][1]}`"
        for axis in axes
        if str(axis) in sizes and sizes[str(axis)][1] != check.name
    ]
    if named_axes:
        message += f" with {' and '.join(named_axes)}"
    if batches is None and len(shape) > len(check.core) and check.variadic is None:
        message += "; map over its leading axes with jax.vmap"
    return message


def _length(size):
    return list(size) if isinstance(size, tuple) else size


def _description(value):
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    return f"a {type(value).__name__}"


def _with_float_images(plan, values, images):
    """Convert integer images to [0, 1], and add a channel axis to gray images."""
    checks = dict(plan.checks)
    shapes = {
        name: np.shape(value)
        for name, value in values.items()
        if name in checks and hasattr(value, "dtype")
    }
    names = [name for name in images if name in shapes]
    wide = any(values[name].dtype == np.float64 for name in names)
    wide = wide and jax.config.jax_enable_x64
    masks = [shape for name, shape in shapes.items() if name not in images]
    float_images = {}
    for name in names:
        image, kind = values[name], np.dtype(values[name].dtype).name
        if kind in FULL_SCALE:
            image = jnp.asarray(image, jnp.float64 if wide else jnp.float32)
            image = image / FULL_SCALE[kind]
        elif kind not in checks[name].kinds:
            raise ValueError(
                f"{plan.title}: `{name}` is {kind}{list(shapes[name])}; images must be "
                "floating-point in [0, 1], uint8 or uint16"
            )
        if checks[name].variadic is None:
            gray = len(shapes[name]) == len(checks[name].core) - 1
        else:  # with any number of axes, an image of the shape of the mask is gray
            gray = shapes[name] in masks
        if gray:
            image = image[..., None]
        if image is not values[name]:
            float_images[name] = image
    return values | float_images if float_images else values


def _map(plan, function, batches, values, positional):
    """Map a function over the broadcast leading axes of its arrays."""
    try:
        batch = np.broadcast_shapes(*(shape for shape, _ in batches))
    except ValueError:
        shapes = ", ".join(f"{list(shape)} of `{name}`" for shape, name in batches)
        raise ValueError(
            f"{plan.title}: leading axes do not broadcast: {shapes}"
        ) from None
    arrays = [
        (name, check, values[name])
        for name, check in plan.checks
        if values.get(name) is not None
    ]
    leaves = [leaf for _, check, value in arrays for leaf in _leaves(check, value)]
    operands, axes = [], []
    for leaf, (shape, _) in zip(leaves, batches, strict=True):
        missing = len(batch) - len(shape)
        # Axes that are missing or broadcast from length one are not mapped.
        mapped_axes = [
            axis >= missing and shape[axis - missing] == batch[axis]
            for axis in range(len(batch))
        ]
        broadcast = [
            axis - missing
            for axis in range(missing, len(batch))
            if not mapped_axes[axis]
        ]
        operands.append(jnp.squeeze(leaf, broadcast) if broadcast else leaf)
        axes.append([0 if is_mapped else None for is_mapped in mapped_axes])

    def call(*leaves):
        remaining = iter(leaves)
        new_values = {
            name: _replace_leaves(check, value, remaining)
            for name, check, value in arrays
        }
        return _call(function, values | new_values, positional)

    for level in reversed(range(len(batch))):
        call = jax.vmap(call, tuple(axis[level] for axis in axes))
    return call(*operands)


def _call(function, values, positional):
    args = [values[name] for name in positional]
    return function(*args, **{k: v for k, v in values.items() if k not in positional})


def _leaves(check, value):
    """Return the checked arrays of one argument, in the order of the checks."""
    if isinstance(check, _Leaf):
        return [value]
    return [
        leaf
        for field, part in zip(check.fields, value, strict=True)
        if field is not None and part is not None
        for leaf in _leaves(field, part)
    ]


def _replace_leaves(check, value, leaves):
    """Replace the checked arrays of one argument by the next ones of `leaves`."""
    if isinstance(check, _Leaf):
        return next(leaves)
    parts = [
        part if field is None or part is None else _replace_leaves(field, part, leaves)
        for field, part in zip(check.fields, value, strict=True)
    ]
    return check.kind(*parts)
