"""JSON files of captures that are written and changed, and how readers refuse them."""

import contextlib
import json

import pytest

from nerfies_jax.capture.capture import CaptureError


def dump(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


@contextlib.contextmanager
def edited(path):
    """The content of a file, which is written back with its changes."""
    content = json.loads(path.read_text())
    yield content
    dump(path, content)


def refused(read, root, refusal):
    """In one line that names the file and says what is wrong with it."""
    with pytest.raises(CaptureError) as caught:
        read(root)
    message = str(caught.value)
    assert refusal in message
    assert str(root) in message
    assert "\n" not in message
