"""Independent writing of products, so that a full disk affects as few as possible."""

from collections.abc import Callable
from typing import TypeVar

from nerfies_jax.capture.capture import CaptureError

Result = TypeVar("Result")


class Attempts:
    """Calls functions that write products, and collects their failures.

    Args:
      all_or_none: True to raise the first failure instead, because the products must
        replace earlier ones together.

    Attributes:
      failures: One line for each product that was not written, with its path and the
        reason.
    """

    def __init__(self, all_or_none: bool):
        self._all_or_none = all_or_none
        self.failures: list[str] = []

    def __call__(
        self, fallback: Result, save: Callable[..., Result], *arguments
    ) -> Result:
        """Return the result of `save`, or `fallback` if it could not write."""
        try:
            return save(*arguments)
        except (OSError, CaptureError) as error:
            if self._all_or_none:
                raise
            self.failures.append(str(error))
            return fallback

    def finish(self) -> None:
        """Report the products that were not written.

        Raises:
          OSError: If there are any, with their paths.
        """
        if self.failures:
            raise OSError("; ".join(dict.fromkeys(self.failures)))
