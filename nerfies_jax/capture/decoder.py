"""Decoding in a child process with limits of memory and time.

Native decoders (pycolmap, OpenEXR, FFmpeg, Pillow for large images) crash, loop or
allocate without bound on damaged files. `decoder_child` runs them, and only plain
arrays and JSON come back. The child ends with this process, however that ends. One
child serves all requests inside a `session`, because starting one takes 0.3 s.
"""

import contextlib
import json
import pathlib
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator
from typing import Any, NamedTuple

import numpy as np

from nerfies_jax.capture.errors import FileError
from nerfies_jax.runtime import children

CPU_SECONDS = 5.0  # for a file of any size, besides what `request` adds
WALL_SECONDS = 120.0  # without an answer: other programs may take the processor
MEMORY_BYTES = 3 * 2**29  # of address space, on top of the child's libraries
MAX_HEADER = 2**28  # bytes of the JSON of an answer
MAX_ANSWER = 2**36  # bytes of its arrays
# By signal: SIGXCPU, SIGKILL of the timer, SIGABRT of a failed check.
_ENDINGS = {-24: "took too much processor time", -9: "took too long", -6: "gave up"}
_KINDS = "biuf"  # of NumPy types that an answer may have


class DecoderError(FileError):
    """Defect of a file as the child reported it, or the way in which the child ended.

    Attributes:
      has_advice: True if the message names the remedy, and lacks only the path.
    """

    has_advice = False


class Answer(NamedTuple):
    """Result of one operation of the child."""

    about: dict[str, Any]
    arrays: dict[str, np.ndarray]


class Decoder:
    """A child process that decodes one file after the other. Threads may share it."""

    def __init__(self):
        self._child: subprocess.Popen | None = None
        self._lock = threading.Lock()

    def request(
        self,
        operation: str,
        cpu_seconds: float = 0.0,
        memory_bytes: int = 0,
        **arguments: Any,
    ) -> Answer:
        """Run an operation of `decoder_child` that has one answer.

        Args:
          operation: Name of the operation.
          cpu_seconds: Processor time that the file may take, besides `CPU_SECONDS`.
          memory_bytes: Memory that it may take, besides `MEMORY_BYTES`.
          **arguments: Arguments of the operation, as JSON values.

        Returns:
          The answer.

        Raises:
          DecoderError: If the file is damaged, or takes too much.
        """
        # To its end: a stream that is given up takes the child with it.
        answers = [*self.stream(operation, cpu_seconds, memory_bytes, **arguments)]
        if not answers:
            raise DecoderError("no answer from its decoder")
        return answers[0]

    def stream(
        self,
        operation: str,
        cpu_seconds: float = 0.0,
        memory_bytes: int = 0,
        **arguments: Any,
    ) -> Generator[Answer, None, None]:
        """Run an operation with any number of answers, as they come.

        Args:
          operation: As for `request`.
          cpu_seconds: As for `request`.
          memory_bytes: As for `request`.
          **arguments: As for `request`.

        Yields:
          The answers. The limit of time is for one answer.

        Raises:
          DecoderError: As for `request`.
        """
        with self._lock:
            job = {
                "operation": operation,
                "cpu_seconds": CPU_SECONDS + cpu_seconds,
                "memory_bytes": MEMORY_BYTES + memory_bytes,
                "arguments": arguments,
            }
            child, complete = self._running(), False
            try:
                child.stdin.write(json.dumps(job).encode() + b"\n")
                child.stdin.flush()
                while (
                    answer := _next_answer(child, WALL_SECONDS + cpu_seconds)
                ) is not None:
                    yield answer
                complete = True
            except _Told as error:
                complete = True
                told = DecoderError(str(error))
                told.has_advice = error.has_advice
                raise told from None
            except (OSError, ValueError, EOFError, KeyError, TypeError) as error:
                raise DecoderError(self._ending(error)) from None
            finally:
                if not complete:  # what it would say yet is of no use
                    self.close()

    def _running(self):
        """Return the child, and start a new one if it has ended."""
        if self._child is None or self._child.poll() is not None:
            self.close()
            root = pathlib.Path(__file__).resolve().parents[2]
            self._child = children.start(
                [sys.executable, "-m", "nerfies_jax.capture.decoder_child"],
                cwd=root,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        return self._child

    def _ending(self, error):
        """Words for how the child ended before it answered."""
        child = self._child
        try:
            code = child.wait(1.0)
        except subprocess.TimeoutExpired:
            return f"no answer from its decoder ({type(error).__name__})"
        names = {
            -24: "took too much processor time",
            -9: "took too long",
            -6: "aborted",
        }
        return f"its decoder {names.get(code, f'ended with code {code}')}"

    def close(self) -> None:
        """End the child, if there is one."""
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        child.wait()


class _Told(Exception):
    """The child found out what is wrong."""

    def __init__(self, message, has_advice):
        super().__init__(message)
        self.has_advice = has_advice


def _next_answer(child, seconds):
    """Return the next answer of the child, None after the last one of a request."""
    timer = threading.Timer(seconds, child.kill)
    timer.daemon = True
    timer.start()
    try:
        line = child.stdout.readline(MAX_HEADER)
        if not line.endswith(b"\n"):
            raise EOFError
        head = json.loads(line)
        if head.get("end"):
            return None
        if "error" in head:
            raise _Told(str(head["error"]), bool(head["has_advice"]))
        arrays, total = {}, 0
        for name, kind, shape in head["arrays"]:
            dtype = np.dtype(str(kind))
            if dtype.kind not in _KINDS:
                raise ValueError(f"an array of {dtype}")
            shape = tuple(int(side) for side in shape)
            total += int(np.prod(shape, dtype=object)) * dtype.itemsize
            if min(shape, default=0) < 0 or total > MAX_ANSWER:
                raise ValueError(f"an array of shape {shape}")
            arrays[name] = array = np.empty(shape, dtype)
            left = memoryview(array.reshape(-1).view(np.uint8))
            while left:
                part = child.stdout.readinto(left)
                if not part:
                    raise EOFError
                left = left[part:]
        return Answer(head["about"], arrays)
    finally:
        timer.cancel()


_shared: Decoder | None = None  # for requests
_spare: Decoder | None = None  # for the next stream
_sessions = 0
_sessions_lock = threading.Lock()


@contextlib.contextmanager
def session() -> Iterator[Decoder]:
    """Keep one child for all requests of the block, and of blocks inside it.

    Yields:
      The decoder.
    """
    global _shared, _spare, _sessions
    with _sessions_lock:
        _shared = _shared or Decoder()
        _sessions += 1
        decoder = _shared
    try:
        yield decoder
    finally:
        with _sessions_lock:
            _sessions -= 1
            if not _sessions:
                decoder.close()
                _shared = None
                if _spare is not None:
                    _spare.close()
                    _spare = None


@contextlib.contextmanager
def streaming() -> Iterator[Decoder]:
    """Use a child for one stream, while others serve requests in between.

    Inside a `session` it is kept for the next stream.

    Yields:
      The decoder.
    """
    global _spare
    with _sessions_lock:
        decoder, _spare = _spare or Decoder(), None
    try:
        yield decoder
    finally:
        with _sessions_lock:
            if _sessions and _spare is None:
                _spare = decoder
            else:
                decoder.close()
