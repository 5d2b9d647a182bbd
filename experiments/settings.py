"""What a user asked for, and the run folder. The only file that reads the CLI library.

JAX is not imported here, so `--help` is quick and `--device` can still choose the
platform.
"""

import contextlib
import dataclasses
import json
import math
import os
import pathlib
import sys
import tempfile
import typing

import tyro

Positional = tyro.conf.Positional
CONFIG = "config.json"  # of a run folder: its choices and its whole spec
CLASS = "class"  # a spec's, in that file; no field can have this name
SPLATS = ("splats", "sonata", "moba")  # what the names of their presets start with
CACHE = (
    pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
    / "nerfies_jax"
)


def parse(settings_class, arguments=None):
    """A frozen dataclass from the command line; its docstrings are the help text."""
    return tyro.cli(settings_class, args=arguments)


def formerly(option):
    """For `Annotated`: the option is understood by its earlier name as well."""
    return tyro.conf.arg(aliases=[option])


@contextlib.contextmanager
def user_errors():
    """Wrong input in one line and exit code 2; our own bugs keep their traceback.

    Wraps the stages that read what the user gave (captures, settings, run folders),
    which raise `ValueError` or `OSError` naming the value, the bound and the mend.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)


def threads_for(preset):
    """Whether XLA:CPU should see "one" core or "all" for the scenes of a preset.

    Splats are tight loops. XLA splits their bodies over all cores it sees and gains
    nothing: 87 to 94 ms a training step with one, 94 to 109 with four (10,000
    Gaussians, 176x132). With one, the bits do not depend on the machine's core count
    either. Radiance fields are matrix products, which every core makes faster.
    """
    return "one" if preset.startswith(SPLATS) else "all"


def stored_preset(folder):
    """The preset of the run in a folder, "" where none can be read; without JAX."""
    try:
        return str(json.loads((folder / CONFIG).read_text())["choices"]["preset"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""  # reading it properly, later, says what is wrong


def start_jax(device, threads="one"):
    """Choose the platform, how many cores XLA:CPU sees, and the compilation cache.

    Call it before anything uses JAX; it is too late afterwards. `PJRT_NPROC` in the
    environment has the last word.
    """
    if threads == "one":
        os.environ.setdefault("PJRT_NPROC", "1")
    if device != "auto":
        os.environ["JAX_PLATFORMS"] = {"gpu": "cuda"}.get(device, device)
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        reason = (str(error).splitlines() or ["JAX finds none"])[0]
        raise ValueError(
            f"--device {device} cannot be used here ({reason}); choose --device cpu, "
            "or install a JAX built for that device"
        ) from error
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        folder = CACHE / "compiled"
        with contextlib.suppress(OSError):  # a cache that cannot be kept is no error
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))


def override(spec, assignments):
    """`spec` with `path.to.field=value` applied, each value read by the field's type.

    A field that holds another spec is set with a dotted path, which brings it in with
    its defaults where it is none, or removed with `none` where its type allows it. The
    name of a spec's class, as `config.json` has it, chooses one of several kinds.
    Raises ValueError for an unknown field or a wrong value.
    """
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise ValueError(f"--set {assignment}: expected path.to.field=value")
        spec = _assign(spec, path.split("."), text, path)
    return spec


def _assign(spec, names, text, path):
    fields = {field.name for field in dataclasses.fields(spec)}
    name, rest = names[0], names[1:]
    if name not in fields:
        raise ValueError(
            f"--set {path}: {type(spec).__name__} has no field {name!r}; "
            f"it has {', '.join(sorted(fields))}"
        )
    if rest:
        inner = getattr(spec, name)
        if inner is None:
            inner = _absent(spec, name)
        if not dataclasses.is_dataclass(inner):
            raise ValueError(f"--set {path}: {name!r} is {inner!r} and has no fields")
        return dataclasses.replace(spec, **{name: _assign(inner, rest, text, path)})
    kind = typing.get_type_hints(type(spec))[name]
    return dataclasses.replace(spec, **{name: _read(kind, text, path)})


def _absent(spec, name):
    """The defaults of an effect that is not there; None unless there is one choice."""
    options = typing.get_args(typing.get_type_hints(type(spec))[name])
    specs = [option for option in options if dataclasses.is_dataclass(option)]
    return _defaults(specs[0], name) if len(specs) == 1 else None


def _read(kind, text, path):
    options = typing.get_args(kind)
    specs = [option for option in options if dataclasses.is_dataclass(option)]
    named = {spec.__name__: spec for spec in specs}
    if text in named:
        return _defaults(named[text], path)
    if type(None) in options:
        if text.lower() == "none":
            return None
        kind = next(option for option in options if option is not type(None))
    if kind is bool and text.lower() in {"true", "false"}:
        return text.lower() == "true"
    origin = typing.get_origin(kind)
    try:
        if kind in {int, float, str}:
            return kind(text)
        if origin is typing.Literal and text in typing.get_args(kind):
            return text
        if origin is tuple:
            item = typing.get_args(kind)[0]
            return tuple(item(part) for part in text.split(",") if part)
    except ValueError:
        pass
    if named:
        kind = f"one of {', '.join(named)}"
    raise ValueError(f"--set {path}={text}: cannot be read as {kind}")


def _defaults(spec_class, path):
    """A spec as it is where nothing is said of its fields."""
    needed = [
        field.name
        for field in dataclasses.fields(spec_class)
        if field.default is field.default_factory is dataclasses.MISSING
    ]
    if needed:
        raise ValueError(
            f"--set {path}: {spec_class.__name__} has no defaults for "
            f"{' and '.join(needed)}; choose a preset that has it"
        )
    return spec_class()


def as_json(spec):
    """A spec as plain data for `config.json`; nested specs keep their class name."""
    if dataclasses.is_dataclass(spec):
        values = {
            field.name: as_json(getattr(spec, field.name))
            for field in dataclasses.fields(spec)
        }
        return {CLASS: type(spec).__name__, **values}
    if isinstance(spec, (tuple, list)):
        return [as_json(item) for item in spec]
    if isinstance(spec, dict):
        return {key: as_json(value) for key, value in spec.items()}
    if isinstance(spec, pathlib.Path):
        return str(spec)
    if isinstance(spec, float) and not math.isfinite(spec):
        return str(spec)  # JSON has no infinity
    return spec


def from_json(spec_class, stored):
    """The spec that `as_json` wrote; a preset may have changed since.

    Raises ValueError where a field is unknown, missing or of another kind.
    """
    hints = typing.get_type_hints(spec_class)
    names = [field.name for field in dataclasses.fields(spec_class)]
    if CLASS not in stored and "kind" in stored:  # written by an earlier version
        stored = {CLASS if key == "kind" else key: x for key, x in stored.items()}
    if stored.get(CLASS) != spec_class.__name__ or {*stored} != {CLASS, *names}:
        raise ValueError(
            f"a stored {stored.get(CLASS)} with {', '.join(sorted(stored))} is no "
            f"{spec_class.__name__} of this version; check out the one that made it"
        )
    return spec_class(**{name: _stored(hints[name], stored[name]) for name in names})


def _stored(kind, value):
    if isinstance(value, dict):
        options = (kind, *typing.get_args(kind))
        specs = [option for option in options if dataclasses.is_dataclass(option)]
        # One of the right name, or the first one, which then says what is wrong.
        specs.sort(key=lambda spec: spec.__name__ != value.get(CLASS))
        return from_json(specs[0], value)
    if kind is float and isinstance(value, str):
        return float(value)
    return tuple(value) if isinstance(value, list) else value


def new_run_folder(asked, stem):
    """An empty writable folder for a run: the one asked for, or `runs/STEM[-n]`.

    Raises ValueError if the folder asked for holds something already, OSError if it
    cannot be written.
    """
    if asked is None:
        number, folder = 1, pathlib.Path("runs", stem)
        while folder.exists():
            number += 1
            folder = pathlib.Path("runs", f"{stem}-{number}")
    else:
        folder = asked
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder}: the run folder is a file; name another --out")
        if folder.is_dir() and any(folder.iterdir()):
            raise ValueError(
                f"{folder}: the run folder is not empty; name another --out, or "
                "continue the run in it with --resume"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"{folder}: the run folder cannot be written ({error.strerror}); "
            "name another --out"
        ) from error
    return folder
