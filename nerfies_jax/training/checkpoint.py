"""Save and restore a run: orbax directories that carry what they were made with."""

import contextlib
import pathlib
import shutil
import subprocess
import sys
import tempfile
import warnings
import zlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import ml_dtypes  # noqa: F401  (NumPy's names for bfloat16 and its kin)
import numpy as np
import orbax.checkpoint as ocp

from nerfies_jax.training.specs import as_json, differences

PyTree = Any

FORMAT = 1
_STATE, _ABOUT = "state", "about"


class Restored(NamedTuple):
    """A run as it was when it was saved."""

    state: PyTree
    step: int
    record: Any  # what the loop keeps beside the state: its history, as JSON values
    about: dict[str, Any]  # revision, versions, spec, checksums


class Checkpoints:
    """Writes the checkpoints of one run; the newest `keep` stay.

    A directory appears under its final name only once everything in it is on disk, so
    a killed process leaves the previous checkpoint intact. Saving copies the arrays and
    writes in the background; `close` waits.
    """

    def __init__(self, folder, spec, *, keep: int = 3, after: int | None = None):
        """`after` is the step the run goes on from, None for a new run."""
        if keep < 1:
            raise ValueError(f"at least one checkpoint must be kept, got keep={keep}")
        self.folder = pathlib.Path(folder).absolute()
        self._about = {"format": FORMAT, "spec": as_json(spec), **provenance()}
        _check_writable(self.folder)
        present = steps(self.folder)
        if after is None and present:
            raise ValueError(
                f"{self.folder} already holds a run, saved at step {present[-1]}; "
                "resume it, or choose another folder"
            )
        for step in present:
            if step > after:  # left behind by a fall-back, never to be continued
                shutil.rmtree(self.folder / str(step))
        self._manager = ocp.CheckpointManager(
            self.folder,
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, create=False, cleanup_tmp_directories=True
            ),
        )

    def save(self, state: PyTree, step: int, record: Any = None) -> None:
        """Save the state after `step` completed steps; nothing where it exists."""
        if self._manager.latest_step() == step:
            return
        leaves, about = _encode(state)
        about = {**self._about, "step": step, "record": record, "leaves": about}
        items = {
            _STATE: ocp.args.StandardSave(leaves),
            _ABOUT: ocp.args.JsonSave(about),
        }
        with self._naming_the_folder():
            self._manager.save(step, args=ocp.args.Composite(**items), force=True)

    def wait(self) -> None:
        """Until everything saved is on disk."""
        with self._naming_the_folder():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Wait, and let go of the folder."""
        self.wait()
        self._manager.close()

    @contextlib.contextmanager
    def _naming_the_folder(self):
        """A failed write, often of the save before: a full disk, a lost folder."""
        try:
            yield
        except Exception as error:  # orbax and tensorstore raise whatever they meet
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(
                f"cannot write checkpoints to {self.folder}: {reason}; the newest that "
                f"is whole is of step {latest(self.folder)}"
            ) from error

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def steps(folder) -> list[int]:
    """Steps of the finished checkpoints in a folder, in order."""
    folder = pathlib.Path(folder)
    if not folder.is_dir():
        return []
    # A checkpoint being written has a suffix; orbax renames it when it is whole.
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit())


def latest(folder) -> int | None:
    """Step of the newest finished checkpoint, or None."""
    return max(steps(folder), default=None)


def restore(folder, example: PyTree, spec, *, step: int | None = None) -> Restored:
    """The newest checkpoint that can be read, or the one of `step`.

    `example` gives the structure alone (a state, or `jax.eval_shape` of one): the first
    axis of an array, such as the capacity in Gaussians, comes from the checkpoint. One
    of another spec is a ValueError that lists the fields; one that is damaged is passed
    over with a warning.
    """
    folder = pathlib.Path(folder).absolute()
    present = steps(folder)
    if step is not None and step not in present:
        raise ValueError(
            f"{folder} has no checkpoint of step {step}, only of {present}"
        )
    if not present:
        raise ValueError(
            f"{folder} holds no checkpoint; start the run without resuming"
        )
    for candidate in [step] if step is not None else reversed(present):
        try:
            leaves, about = _read(folder / str(candidate))
        except _Damaged as error:
            message = f"checkpoint {folder / str(candidate)} cannot be read ({error})"
            if step is not None or candidate == present[0]:
                raise ValueError(f"{message}; none that is older is left") from error
            warnings.warn(f"{message}; trying the one before", RuntimeWarning, 2)
            continue
        changed = differences(about["spec"], as_json(spec))
        if changed:
            raise ValueError(
                f"checkpoint {folder / str(candidate)} was made with other settings: "
                + "; ".join(changed)
            )
        state = _decode(leaves, about["leaves"], example, folder / str(candidate))
        return Restored(state, about["step"], about["record"], about)
    raise AssertionError("unreachable: the oldest candidate returns or raises")


class _Damaged(Exception):
    """A checkpoint that is not what was written."""


def _encode(state):
    """Leaves by path as host arrays of their own, and what orbax does not keep."""
    leaves, about = {}, {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        note = {}
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            note["key"] = str(jax.random.key_impl(leaf))
            leaf = jax.random.key_data(leaf)
        # A copy: the loop overwrites its arrays while orbax still writes.
        array = np.array(leaf, copy=True)
        note |= {"dtype": str(array.dtype), "shape": list(array.shape)}
        note["crc32"] = zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)
        if array.size:  # orbax refuses empty arrays
            leaves[name] = array
        about[name] = note
    return leaves, about


def _read(folder):
    """Leaves and notes of one checkpoint; _Damaged unless every byte is as written."""
    try:
        checkpointer = ocp.Checkpointer(ocp.CompositeCheckpointHandler(_STATE, _ABOUT))
        about = checkpointer.restore(
            folder, args=ocp.args.Composite(**{_ABOUT: ocp.args.JsonRestore()})
        )[_ABOUT]
        notes = about["leaves"]
        expected = {
            name: np.empty(note["shape"], note["dtype"])
            for name, note in notes.items()
            if 0 not in note["shape"]
        }
        leaves = checkpointer.restore(
            folder,
            args=ocp.args.Composite(**{_STATE: ocp.args.StandardRestore(expected)}),
        )[_STATE]
    except Exception as error:  # orbax and tensorstore raise whatever they meet
        raise _Damaged(
            f"{type(error).__name__}: {str(error).splitlines()[:1]}"
        ) from error
    for name, note in notes.items():
        empty = 0 in note["shape"]
        array = np.empty(note["shape"], note["dtype"]) if empty else leaves[name]
        leaves[name] = array = np.asarray(array)
        # tensorstore fills a missing chunk with zeros and says nothing.
        if zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data) != note["crc32"]:
            raise _Damaged(f"{name} is not what was saved")
    return leaves, about


def _decode(leaves, notes, example, source):
    """The leaves in the structure of `example`, on the device."""
    paths, structure = jax.tree_util.tree_flatten_with_path(example)
    wanted = {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in paths
    }
    if wanted.keys() != notes.keys():
        missing, unknown = wanted.keys() - notes.keys(), notes.keys() - wanted.keys()
        raise ValueError(
            f"checkpoint {source} has another structure: without {sorted(missing)}, "
            f"with {sorted(unknown)} beside; it was saved by another version"
        )
    decoded = []
    for name, like in wanted.items():
        array = leaves[name]
        if "key" in notes[name]:
            decoded.append(jax.random.wrap_key_data(array, impl=notes[name]["key"]))
            continue
        same = array.dtype == like.dtype and array.ndim == like.ndim
        if not same or array.shape[1:] != like.shape[1:]:
            raise ValueError(
                f"checkpoint {source} holds {name} as {array.dtype}"
                f"{list(array.shape)}, this run needs {like.dtype}{list(like.shape)}; "
                "only the first axis may differ; for another precision set "
                "jax_enable_x64 as it was"
            )
        decoded.append(jnp.array(array))
    return jax.tree_util.tree_unflatten(structure, decoded)


def _check_writable(folder):
    """Refuse before the first step, not at the first save, what cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"cannot write checkpoints to {folder}: {error.strerror}; "
            "choose a folder that can be written"
        ) from error


def provenance() -> dict[str, Any]:
    """What made a checkpoint: revision, versions, and what its last bits depend on."""
    return {
        "revision": revision(),
        "python": sys.version.split()[0],
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
        "x64": bool(jax.config.jax_enable_x64),
    }


def revision() -> str:
    """Git revision this library runs from, with "+changes"; "unknown" outside git."""
    here = pathlib.Path(__file__).resolve().parents[2]
    if not (here / ".git").exists():  # installed, perhaps inside another repository
        return "unknown"
    command = "describe --always --exclude=* --dirty=+changes --abbrev=40"
    try:
        text = subprocess.run(
            ["git", "-C", here, *command.split()],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return text.strip()
