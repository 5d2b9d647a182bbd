"""Independent writing of products, so that a full disk loses as few as possible."""

from collections.abc import Callable
from typing import TypeVar

from nerfies_jax.capture.capture import CaptureError

Result = TypeVar("Result")


class Attempts:
    """Calls functions that write products, and remembers failures.

    Attributes:
      failures: One line for each product that was not written, with its path and the
        reason.
    """

    def __init__(self, together: bool):
        """`together` raises the first failure: the products replace earlier ones."""
        self._together = together
        self.failures: list[str] = []

    def __call__(
        self, otherwise: Result, save: Callable[..., Result], *arguments, **named
    ) -> Result:
        """Return what `save` returns, or `otherwise` where it could not write."""
        try:
            return save(*arguments, **named)
        except (OSError, CaptureError) as error:
            if self._together:
                raise
            self.failures.append(str(error))
            return otherwise

    def finish(self) -> None:
        """Report the products that were not written.

        Raises:
          OSError: If there are any, with their paths.
        """
        if self.failures:
            raise OSError("; ".join(dict.fromkeys(self.failures)))
