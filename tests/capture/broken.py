"""How the readers refuse what is broken."""

import pytest

from nerfies_jax.capture.capture import CaptureError


def refused(read, root, refusal):
    """In one line that names the file and says what is wrong with it."""
    with pytest.raises(CaptureError) as caught:
        read(root)
    message = str(caught.value)
    assert refusal in message
    assert str(root) in message
    assert "\n" not in message
