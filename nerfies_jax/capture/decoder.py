"""Decoding in a child process with limits of memory and time.

Native decoders (pycolmap, OpenEXR, FFmpeg, Pillow for large images) may crash, loop
forever or allocate without bound on damaged files. They run in `decoder_child`, which
returns only arrays and JSON. The child ends with this process in any case. One child
serves all requests within a `session`, because starting one takes 0.3 s.
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
from nerfies_jax.runtime import children, stopping

CPU_SECONDS = 5.0  # for a file of any size, in addition to that of the request
# Without an answer. Long, since other programs may use the processor.
WALL_SECONDS = 120.0
MEMORY_BYTES = 3 * 2**29  # of address space, in addition to the child's libraries
MAX_HEADER = 2**28  # bytes of the JSON of an answer
MAX_ANSWER = 2**36  # bytes of its arrays
# By exit code: SIGXCPU, SIGKILL by the timer, SIGABRT of a failed assertion.
_ENDINGS = {-24: "took too much processor time", -9: "took too long", -6: "aborted"}
_KINDS = "biuf"  # kinds of NumPy types that an answer may have


class DecoderError(FileError):
    """A defect of a file that the child reported, or an unexpected end of the child.

    Attributes:
      has_advice: True if the message includes the remedy, and lacks only the path.
    """

    has_advice = False


class Answer(NamedTuple):
    """Result of one operation of the child."""

    about: dict[str, Any]
    arrays: dict[str, np.ndarray]


class Decoder:
    """A child process that decodes one file after the other, for any thread."""

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
          cpu_seconds: Processor time allowed in addition to `CPU_SECONDS`.
          memory_bytes: Memory allowed in addition to `MEMORY_BYTES`.
          **arguments: Arguments of the operation, as JSON values.

        Returns:
          The answer.

        Raises:
          DecoderError: If the file is damaged, or exceeds a limit.
        """
        # Exhausted, since a stream that is closed early ends the child.
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
        """Run an operation with any number of answers.

        Args:
          operation: As for `request`.
          cpu_seconds: As for `request`.
          memory_bytes: As for `request`.
          **arguments: As for `request`.

        Yields:
          The answers as they arrive. The time limit holds for each answer.

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
            except DecoderError:  # reported by the child
                complete = True
                raise
            except (OSError, ValueError, EOFError, KeyError, TypeError) as error:
                reason = self._ending(error)
                # A signal to the process group ended the child as well.
                stopping.check()
                raise DecoderError(reason) from None
            finally:
                if not complete:  # its remaining answers would confuse the next request
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
        """Describe how the child ended before it answered."""
        try:
            code = self._child.wait(1.0)
        except subprocess.TimeoutExpired:
            return f"no answer from its decoder ({type(error).__name__})"
        return f"its decoder {_ENDINGS.get(code, f'ended with code {code}')}"

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
            failure = DecoderError(str(head["error"]))
            failure.has_advice = bool(head["has_advice"])
            raise failure
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
            remaining = memoryview(array.reshape(-1).view(np.uint8))
            while remaining:
                part = child.stdout.readinto(remaining)
                if not part:
                    raise EOFError
                remaining = remaining[part:]
        return Answer(head["about"], arrays)
    finally:
        timer.cancel()


_session_decoder: Decoder | None = None  # serves requests
_spare: Decoder | None = None  # kept for the next stream
_sessions = 0
_sessions_lock = threading.Lock()


@contextlib.contextmanager
def session() -> Iterator[Decoder]:
    """Keep one child for all requests of the block and of nested blocks.

    Yields:
      The decoder.
    """
    global _session_decoder, _spare, _sessions
    with _sessions_lock:
        _session_decoder = _session_decoder or Decoder()
        _sessions += 1
        decoder = _session_decoder
    try:
        yield decoder
    finally:
        with _sessions_lock:
            _sessions -= 1
            if not _sessions:
                decoder.close()
                _session_decoder = None
                if _spare is not None:
                    _spare.close()
                    _spare = None


@contextlib.contextmanager
def streaming() -> Iterator[Decoder]:
    """Reserve a child for one stream, while other children serve requests.

    Within a `session` the child is kept for the next stream.

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
