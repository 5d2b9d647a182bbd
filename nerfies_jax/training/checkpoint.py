"""Save and restore runs as orbax directories with metadata."""

import concurrent.futures
import contextlib
import json
import logging
import os
import pathlib
import shutil
import tempfile
import warnings
import zlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import ml_dtypes  # noqa: F401  (registers bfloat16 and similar types with NumPy)
import numpy as np
import orbax.checkpoint as ocp

from nerfies_jax.training.provenance import provenance
from nerfies_jax.training.specs import as_json, differences

PyTree = Any

FORMAT = 2
SPARE_BYTES = 2**20  # for the metadata
_UNFINISHED = ".unfinished"
_STATE, _ABOUT = "state", "about.json"


class Restored(NamedTuple):
    """State and metadata of a saved run."""

    state: PyTree
    step: int
    record: Any  # further JSON values of the training loop, such as its history
    about: dict[str, Any]  # metadata: revision, versions, spec, checksums


class SaveError(ValueError):
    """A checkpoint could not be written. Earlier checkpoints are intact."""


class Checkpoints:
    """Writer of the checkpoints of one run, which keeps the newest `keep`.

    The checkpoint of step `best`, if it is set, is kept as well.

    A directory gets its final name only when all of its contents are on disk, so a
    killed process leaves the previous checkpoint intact. Saving copies the arrays and
    writes in the background. If writing fails, SaveError is raised at the next `save`,
    `wait` or `close`, unless `failure` has returned it.
    """

    def __init__(
        self,
        folder,
        spec,
        *,
        keep: int = 3,
        after: int | None = None,
        beside: pathlib.Path | None = None,
    ):
        """Prepare the folder.

        `after` is the step from which the run is resumed, None for a new run. `beside`
        is a file without which checkpoints are useless: nothing is saved once it has
        been deleted.
        """
        if keep < 1:
            raise ValueError(f"keep={keep} must be at least 1 checkpoint")
        self.folder = pathlib.Path(folder).absolute()
        self._keep, self._beside = keep, beside
        self.best: int | None = None
        self._about = {"format": FORMAT, "spec": as_json(spec), **provenance()}
        _check_writable(self.folder)
        present = steps(self.folder)
        if after is None and present:
            raise ValueError(
                f"{self.folder} already holds a run, saved at step {present[-1]}; "
                "resume it, or choose another folder"
            )
        for step in present:
            # Left over after falling back to an older checkpoint.
            if after is not None and step > after:
                shutil.rmtree(self.folder / str(step))
        self._remove_unfinished()
        self._writer = concurrent.futures.ThreadPoolExecutor(1, "checkpoints")
        self._writing: concurrent.futures.Future | None = None

    def save(self, state: PyTree, step: int, record: Any = None) -> None:
        """Save the state after `step` completed steps, unless it is already saved.

        Args:
          state: Training state, a pytree of arrays.
          step: Number of completed steps, the name of the checkpoint.
          record: JSON values that are stored with the state, such as the history.

        Raises:
          SaveError: If the previous save failed.
        """
        self.wait()
        if latest(self.folder) == step and not self._is_orphaned():
            return
        leaves, notes = _encode(state)
        about = {**self._about, "step": step, "record": record, "leaves": notes}
        self._writing = self._writer.submit(self._write, step, leaves, about)

    def failure(self, wait: bool = False) -> BaseException | None:
        """Return the error of the last save, once.

        Args:
          wait: True to wait until the write has ended.

        Returns:
          The error, or None if the save did not fail, has not ended or was already
          reported.
        """
        if self._writing is None or not (wait or self._writing.done()):
            return None
        error, self._writing = self._writing.exception(), None
        return error

    def wait(self) -> None:
        """Wait until everything saved is on disk.

        Raises:
          SaveError: If the last save failed.
        """
        error = self.failure(wait=True)
        if error is not None:
            raise error

    def close(self) -> None:
        """Wait for the last save and stop the writer.

        Raises:
          SaveError: If the last save failed.
        """
        self._writer.shutdown()
        self.wait()

    def _write(self, step, leaves, about):
        try:
            self._check_room(leaves)
            for name, array in leaves.items():
                about["leaves"][name]["crc32"] = _checksum(array)
            about["crc32"] = _text_checksum(about)
            partial = self.folder / f"{step}{_UNFINISHED}"
            _write_arrays(partial / _STATE, leaves)
            _write_text(partial / _ABOUT, json.dumps(about))
            partial.rename(self.folder / str(step))
            for old in steps(self.folder)[: -self._keep]:
                if old != self.best:
                    shutil.rmtree(self.folder / str(old))
        except Exception as error:  # orbax and tensorstore raise many types
            self._remove_unfinished()
            reason = getattr(error, "strerror", None) or str(error) or repr(error)
            last = latest(self.folder)
            previous = (
                "there is no earlier checkpoint"
                if last is None
                else f"the checkpoint of step {last} is intact"
            )
            raise SaveError(
                f"cannot write checkpoints to {self.folder}: "
                f"{reason.splitlines()[0]}; {previous}"
            ) from error

    def _check_room(self, leaves):
        """Raise OSError if writing is bound to fail, before orbax starts."""
        if self._is_orphaned():
            raise FileNotFoundError(f"{self._beside} no longer exists")
        with tempfile.TemporaryFile(dir=self.folder):
            pass
        required_bytes = sum(array.nbytes for array in leaves.values()) + SPARE_BYTES
        free = shutil.disk_usage(self.folder).free
        if free < required_bytes:
            raise OSError(
                f"no space: up to {required_bytes / 1e6:.1f} MB are needed and "
                f"{free / 1e6:.1f} MB are free"
            )

    def _is_orphaned(self):
        return self._beside is not None and not self._beside.exists()

    def _remove_unfinished(self):
        for path in self.folder.glob(f"*{_UNFINISHED}*"):
            shutil.rmtree(path, ignore_errors=True)

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if kind is None:
            self.close()
        else:  # do not replace the exception that ended the block
            self._writer.shutdown()


def _write_arrays(folder, leaves):
    """Write arrays by orbax's handler for arrays only.

    The threads of its checkpointers and managers wait for each other by the wall clock.
    After a failed write they block the process for up to 300 s, and a save fails if the
    clock is set forward.
    """
    folder.mkdir(parents=True)
    # orbax refuses empty arrays
    nonempty = {name: array for name, array in leaves.items() if array.size}
    with _quiet_orbax(), contextlib.closing(_array_handler()) as handler:
        handler.save(folder, args=ocp.args.StandardSave(nonempty))
        handler.finalize(folder)


def _read_arrays(folder, templates):
    with contextlib.closing(_array_handler()) as handler:
        args = ocp.args.StandardRestore(templates)
        return handler.restore(folder, args=args)


def _array_handler():
    return ocp.StandardCheckpointHandler()


@contextlib.contextmanager
def _quiet_orbax():
    """Silence orbax's log, which prints a traceback for each array it cannot write."""
    logger = logging.getLogger("absl")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def _write_text(path, text):
    with path.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def steps(folder) -> list[int]:
    """List the finished checkpoints of a folder.

    Args:
      folder: Folder of the checkpoints, which may be missing.

    Returns:
      Their steps, in ascending order.
    """
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        return []
    # A checkpoint has a suffix until it is complete.
    names = (path.name for path in folder.iterdir())
    return sorted(int(name) for name in names if name.isascii() and name.isdigit())


def latest(folder) -> int | None:
    """Return the newest finished checkpoint of a folder.

    Args:
      folder: Folder of the checkpoints, which may be missing.

    Returns:
      Its step, or None if there is none.
    """
    return max(steps(folder), default=None)


def restore(folder, example: PyTree, spec, *, step: int | None = None) -> Restored:
    """Restore the newest checkpoint that can be read, or the one of a step.

    A damaged checkpoint is skipped with a warning.

    Args:
      folder: Folder of the checkpoints.
      example: A state, or `jax.eval_shape` of one, which gives the tree structure. The
        first axis of an array, such as the capacity in Gaussians, comes from the
        checkpoint.
      spec: The settings with which the run must have been made.
      step: Number of completed steps. None for the newest.

    Returns:
      The state with its metadata.

    Raises:
      ValueError: If there is no checkpoint, none can be read, or it has another spec.
        The message lists the fields that differ.
    """
    folder = pathlib.Path(folder).absolute()
    present = steps(folder)
    if step is not None and step not in present:
        raise ValueError(
            f"{folder} has no checkpoint of step {step}; choose from {present}"
        )
    if not present:
        raise ValueError(
            f"{folder} holds no checkpoint; a run saves the first one when training "
            "begins"
        )
    for candidate in [step] if step is not None else reversed(present):
        try:
            leaves, about = _read(folder / str(candidate))
        except _Damaged as error:
            message = f"checkpoint {folder / str(candidate)} cannot be read ({error})"
            if step is not None or candidate == present[0]:
                raise ValueError(f"{message}; there is no older one") from error
            warnings.warn(f"{message}; trying an older one", RuntimeWarning, 2)
            continue
        changes = differences(about["spec"], as_json(spec))
        if changes:
            raise ValueError(
                f"checkpoint {folder / str(candidate)} was made with other settings: "
                + "; ".join(changes)
            )
        state = _decode(leaves, about["leaves"], example, folder / str(candidate))
        return Restored(state, about["step"], about["record"], about)
    raise AssertionError("unreachable: the oldest candidate returns or raises")


class _Damaged(Exception):
    """The contents of a checkpoint differ from those that were written."""


class _NewerFormat(ValueError):
    """A checkpoint was written by a newer version."""


def _encode(state):
    """Copy leaves to the host by path, with metadata that orbax does not store."""
    leaves, about = {}, {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        note = {}
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            note["key"] = str(jax.random.key_impl(leaf))
            leaf = jax.random.key_data(leaf)
        # A copy, because the loop overwrites its arrays while orbax writes.
        leaves[name] = array = np.array(leaf, copy=True)
        about[name] = note | {"dtype": str(array.dtype), "shape": list(array.shape)}
    return leaves, about


def _checksum(array):
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)


def _text_checksum(about):
    """Compute the checksum of the metadata without its own entry."""
    content = {key: value for key, value in about.items() if key != "crc32"}
    return zlib.crc32(json.dumps(content, sort_keys=True).encode())


def _read_about(folder):
    about = json.loads((folder / _ABOUT).read_text())
    if isinstance(about.get("format"), int) and about["format"] > FORMAT:
        raise _NewerFormat(
            f"checkpoint {folder} has format {about['format']}, but this version reads "
            f"formats up to {FORMAT}; resume the run with the version that saved it"
        )
    if about["crc32"] != _text_checksum(about):
        raise _Damaged("its metadata differ from what was saved")
    return about


def _read(folder):
    """Read a checkpoint. Raise _Damaged if a byte has changed."""
    try:
        about = _read_about(folder)
        notes = about["leaves"]
        templates = {
            name: np.empty(note["shape"], note["dtype"])
            for name, note in notes.items()
            if 0 not in note["shape"]
        }
        leaves = _read_arrays(folder / _STATE, templates)
    except (_Damaged, _NewerFormat):
        raise
    except Exception as error:  # orbax and tensorstore raise many types
        raise _Damaged(
            f"{type(error).__name__}: {str(error).splitlines()[:1]}"
        ) from error
    for name, note in notes.items():
        empty = 0 in note["shape"]
        array = np.empty(note["shape"], note["dtype"]) if empty else leaves[name]
        leaves[name] = array = np.asarray(array)
        # tensorstore silently fills missing chunks with zeros.
        if _checksum(array) != note["crc32"]:
            raise _Damaged(f"{name} differs from what was saved")
    return leaves, about


def _decode(leaves, notes, example, source):
    """Arrange the leaves in the structure of `example`, on the device."""
    paths, structure = jax.tree_util.tree_flatten_with_path(example)
    templates = {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in paths
    }
    if templates.keys() != notes.keys():
        missing, unknown = (
            templates.keys() - notes.keys(),
            notes.keys() - templates.keys(),
        )
        raise ValueError(
            f"checkpoint {source} was saved by another version: it lacks "
            f"{sorted(missing)} and has the unknown {sorted(unknown)}"
        )
    arrays = []
    for name, template in templates.items():
        array = leaves[name]
        if "key" in notes[name]:
            arrays.append(jax.random.wrap_key_data(array, impl=notes[name]["key"]))
            continue
        same = array.dtype == template.dtype and array.ndim == template.ndim
        if not same or array.shape[1:] != template.shape[1:]:
            raise ValueError(
                f"checkpoint {source} holds {name} as {array.dtype}"
                f"{list(array.shape)}, but this run needs "
                f"{template.dtype}{list(template.shape)}; only the first axis may "
                "differ; for another precision set jax_enable_x64 as in the saved run"
            )
        arrays.append(jnp.array(array))
    return jax.tree_util.tree_unflatten(structure, arrays)


def _check_writable(folder):
    """Raise ValueError before the first step if checkpoints cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"cannot write checkpoints to {folder}: {error.strerror}; "
            "choose a writable folder"
        ) from error
