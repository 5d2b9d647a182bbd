"""Trace-time checks of the arguments of public functions.

The jaxtyping annotations of a function are its contract. `checked` checks shapes, ranks
and types of the arguments against them on every call, in Python. Under `jax.jit` that
is once, while tracing, and the compiled program is that of the undecorated function.
With `broadcast=True` a function that is written for one item also takes any number of
leading axes, which broadcast against each other as in NumPy.

NumPy arrays become JAX arrays, and Python numbers are taken for scalars. Everything
else is refused with a `ValueError` that names the function, the argument, its value and
the expected shape and type.
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

REMEMBERED = 1000  # shapes of arguments of one function that are not checked again
ANY = "_"  # an axis of any length
# Full scale of the integer images that are converted.
FULL_SCALE = {"uint8": 255.0, "uint16": 65535.0}


class _Leaf(NamedTuple):
    """One array argument, or one array field of a NamedTuple argument."""

    name: str
    kinds: frozenset[str]  # names of the types it may have
    before: tuple[int | str, ...]  # axes in front of the variadic ones, or all
    variadic: str | None  # None where there are none
    after: tuple[int | str, ...]  # axes behind the variadic ones
    optional: bool
    host: bool  # stays a NumPy array
    number: bool  # Python numbers are annotated, and stay as they are

    @property
    def core(self) -> tuple[int | str, ...]:
        return self.before + self.after


class _Record(NamedTuple):
    """An argument that is a NamedTuple of arrays."""

    name: str
    kind: type
    fields: tuple["_Leaf | _Record | None", ...]  # None is not checked
    optional: bool


class _Plan(NamedTuple):
    title: str  # "so3.exp"
    names: tuple[str, ...]  # of all parameters, in order
    checks: tuple[tuple[str, _Leaf | _Record], ...]  # of those that are checked


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
      function: The function. Its arrays are annotated with jaxtyping types; arguments
        with other annotations pass unchecked. NamedTuples are checked field by field.
      broadcast: True if the function is written for one item and shall map over leading
        axes. Each array argument may then have any number of them, and those of all
        arguments broadcast. Without any the function is called as it is.
      images: Names of arguments that are images. uint8 and uint16 images are divided by
        255 and 65535. A gray image [height, width] gets a channel axis where
        the annotation has one.

    Returns:
      The function with the checks in front. It costs nothing under `jax.jit`.

    Raises:
      ValueError: At a call, where an argument has another rank, another length of an
        axis or another type than its annotation says, or where one name of an axis
        stands for two lengths.
    """
    if function is None:
        return functools.partial(checked, broadcast=broadcast, images=tuple(images))
    plan: _Plan | None = None
    passed: set[Any] = set()  # arguments that go to the function as they are

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal plan
        if plan is None:  # at the first call: importing costs nothing
            plan = _plan(function)
        positional = plan.names[: len(args)]
        if len(args) > len(positional) or not kwargs.keys().isdisjoint(positional):
            return function(*args, **kwargs)  # raises Python's own TypeError
        values = dict(zip(positional, args, strict=True)) | kwargs
        key = _key(plan, values)
        if key in passed:
            return function(*args, **kwargs)
        given = values
        if images:
            values = _with_float_images(plan, values, images)
        as_given = values is given
        sizes: dict[str, tuple[Any, str]] = {}
        batches: list[tuple[tuple[int, ...], str]] | None = [] if broadcast else None
        for name, check in plan.checks:
            if name in values:
                values[name] = _check(plan.title, check, values[name], sizes, batches)
        if batches and any(shape for shape, _ in batches):
            return _mapped(plan, function, batches, values, positional)
        if key is not None and as_given and len(passed) < REMEMBERED:
            passed.add(key)
        return _call(function, values, positional)

    return call


def _key(plan, values):
    """Types and shapes of the arguments, None unless all are JAX arrays or None."""
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
    """Return the check that an annotation asks for, or None if it is not of arrays."""
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
        else:
            known = (
                int(axis) if axis.isdigit() else axis if axis.isidentifier() else ANY
            )
            (before if variadic is None else after).append(known)
    return _Leaf(
        name, kinds, tuple(before), variadic, tuple(after), optional, host, number
    )


def _check(title, check, value, sizes, batches):
    """Return the value as the function gets it, or raise ValueError."""
    if value is None and check.optional:
        return None
    if isinstance(check, _Record):
        if not isinstance(value, check.kind):
            raise ValueError(
                f"{title}: `{check.name}` must be a {check.kind.__name__}, got "
                f"{_described(value)}"
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
        f"{title}: `{check.name}` must be an array, got {_described(value)}; convert "
        "it with jnp.asarray"
    )


def _check_kind(title, check, array):
    kind = array.dtype.name
    if kind in check.kinds or (
        "prng_key" in check.kinds and jnp.issubdtype(array.dtype, jax.dtypes.prng_key)
    ):
        return
    if "prng_key" in check.kinds:
        wanted, remedy = "a key", "make it with jax.random.key(seed)"
    elif "float32" in check.kinds:
        wanted, remedy = "floating-point", "cast it with .astype(jnp.float32)"
    elif "bool" in check.kinds:
        wanted, remedy = "boolean", "compare it, as in mask != 0"
    else:
        wanted, remedy = "integer", "cast it with .astype(jnp.int32)"
    raise ValueError(
        f"{title}: `{check.name}` must be {wanted}, got {kind}{list(array.shape)}; "
        f"{remedy}"
    )


def _check_shape(title, check, shape, sizes, batches):
    spare = len(shape) - len(check.core)
    front = len(check.before)
    if batches is None:
        fits = spare == 0 if check.variadic is None else spare >= 0
        lengths = shape[:front] + shape[len(shape) - len(check.after) :]
        if fits and check.variadic:
            middle = shape[front : front + spare]
            fits = sizes.setdefault(f"*{check.variadic}", (middle, check.name))[0] == (
                middle
            )
    else:
        fits = spare >= 0
        lengths = shape[max(spare, 0) :]
        batches.append((shape[: max(spare, 0)], check.name))
    if fits:
        for axis, length in zip(check.core, lengths, strict=True):
            if isinstance(axis, int):
                fits = fits and axis == length
            elif axis != ANY:
                known = sizes.setdefault(axis, (length, check.name))[0]
                fits = fits and known == length
    if not fits:
        raise ValueError(_shape_message(title, check, shape, sizes, batches))


def _shape_message(title, check, shape, sizes, batches):
    named = batches is None and check.variadic
    middle = [f"*{check.variadic}" if named else "..."]
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
    known = [
        f"{axis} = {_length(sizes[str(axis)][0])} from `{sizes[str(axis)][1]}`"
        for axis in axes
        if str(axis) in sizes and sizes[str(axis)][1] != check.name
    ]
    if known:
        message += f" with {' and '.join(known)}"
    if batches is None and len(shape) > len(check.core) and check.variadic is None:
        message += "; map over its leading axes with jax.vmap"
    return message


def _length(size):
    return list(size) if isinstance(size, tuple) else size


def _described(value):
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}{list(value.shape)}"
    return f"a {type(value).__name__}"


def _with_float_images(plan, values, images):
    """The arguments with integer images in [0, 1] and a channel axis on gray ones."""
    checks = dict(plan.checks)
    shapes = {
        name: np.shape(value)
        for name, value in values.items()
        if name in checks and hasattr(value, "dtype")
    }
    given = [name for name in images if name in shapes]
    wide = any(values[name].dtype == np.float64 for name in given)
    wide = wide and jax.config.jax_enable_x64
    masks = [shape for name, shape in shapes.items() if name not in images]
    converted = {}
    for name in given:
        image, kind = values[name], np.dtype(values[name].dtype).name
        if kind in FULL_SCALE:
            image = jnp.asarray(image, jnp.float64 if wide else jnp.float32)
            image = image / FULL_SCALE[kind]
        elif kind not in checks[name].kinds:
            raise ValueError(
                f"{plan.title}: `{name}` is {kind}{list(shapes[name])}; images are "
                "floating-point in [0, 1], uint8 or uint16"
            )
        if checks[name].variadic is None:
            gray = len(shapes[name]) == len(checks[name].core) - 1
        else:  # any shape and channels: gray where the mask has the same axes
            gray = shapes[name] in masks
        if gray:
            image = image[..., None]
        if image is not values[name]:
            converted[name] = image
    return values | converted if converted else values


def _mapped(plan, function, batches, values, positional):
    """The function mapped over the broadcast leading axes of its arrays."""
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
    squeezed, axes = [], []
    for leaf, (shape, _) in zip(leaves, batches, strict=True):
        missing = len(batch) - len(shape)
        # An axis of length one is not mapped where the batch is longer there.
        mapped = [
            place >= missing and shape[place - missing] == batch[place]
            for place in range(len(batch))
        ]
        dropped = [
            place - missing for place in range(missing, len(batch)) if not mapped[place]
        ]
        squeezed.append(jnp.squeeze(leaf, dropped) if dropped else leaf)
        axes.append([0 if use else None for use in mapped])

    def one(*leaves):
        rest = iter(leaves)
        filled = {name: _filled(check, value, rest) for name, check, value in arrays}
        return _call(function, values | filled, positional)

    for level in reversed(range(len(batch))):
        one = jax.vmap(one, tuple(axis[level] for axis in axes))
    return one(*squeezed)


def _call(function, values, positional):
    args = [values[name] for name in positional]
    return function(*args, **{k: v for k, v in values.items() if k not in positional})


def _leaves(check, value):
    """The checked arrays of one argument, in the order in which they are checked."""
    if isinstance(check, _Leaf):
        return [value]
    return [
        leaf
        for field, part in zip(check.fields, value, strict=True)
        if field is not None and part is not None
        for leaf in _leaves(field, part)
    ]


def _filled(check, value, leaves):
    """The argument with its checked arrays taken from `leaves`."""
    if isinstance(check, _Leaf):
        return next(leaves)
    parts = [
        part if field is None or part is None else _filled(field, part, leaves)
        for field, part in zip(check.fields, value, strict=True)
    ]
    return check.kind(*parts)
