"""Access control of the viewer: only pages that it has served itself may connect.

viser listens on the loopback address but performs no other checks. Any web site that is
open in the same browser could connect to it, directly or through a domain name that
resolves to 127.0.0.1 (DNS rebinding), and operate the viewer.
"""

import contextlib
import http
import importlib
import logging
import threading
import urllib.parse
from collections.abc import Callable, Iterator
from typing import Any

HOST = "127.0.0.1"  # address that the viewer listens on
NAMES = (HOST, "localhost")  # host names that its own page may use
_LOGGER = "nerfies_jax.viewer"
_patching = threading.Lock()


def _refusal(host: str | None, origin: str | None, port: int) -> str | None:
    """Decide whether a request is refused."""
    allowed_hosts = [f"{name}:{port}" for name in NAMES]
    if port == 80:
        allowed_hosts += NAMES
    if host is None or host.lower() not in allowed_hosts:
        return (
            f"Host {host!r} is not {' or '.join(allowed_hosts)}. To view from another "
            "machine, forward this port with the same number: "
            f"ssh -L {port}:{HOST}:{port}"
        )
    if origin is not None:
        try:
            parts = urllib.parse.urlsplit(origin)
        except ValueError:
            parts = urllib.parse.urlsplit("")
        if parts.scheme != "http" or parts.netloc.lower() not in allowed_hosts:
            return f"Origin {origin!r} is another site."
    return None


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Check the requests of every viser server that is started in this block.

    viser has no option for a request handler. It passes its own one to
    `websockets.asyncio.server.serve`, so that function is replaced until the server
    listens.

    Yields:
      None.
    """
    websockets_server: Any = importlib.import_module("websockets.asyncio.server")

    with _patching:
        original = websockets_server.serve

        def serve(*args: Any, process_request: Callable, **options: Any):
            return original(
                *args,
                process_request=_check_access(process_request),
                logger=_logger(),
                **options,
            )

        websockets_server.serve = serve
        try:
            yield
        finally:
            websockets_server.serve = original


def _check_access(process_request):
    """Wrap a request handler to answer 403 if `_refusal` returns a reason."""

    def process(connection, request):
        headers = request.headers
        port = connection.local_address[1]
        # A repeated header is never valid.
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = hosts[0] if len(hosts) == 1 else None
        origin = ", ".join(origins) if origins else None
        reason = _refusal(host, origin, port)
        if reason is None:
            return process_request(connection, request)
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {reason}\n")

    return process


class _DisconnectFilter(logging.Filter):
    """Drops log records about connections that were closed before their first request.

    Browsers open connections in advance and close tabs during requests. Neither is an
    error of the server.
    """

    def filter(self, record):
        error = record.exc_info[1] if record.exc_info else None
        chain = []
        while error is not None and error not in chain:
            if isinstance(error, EOFError | ConnectionError):
                return False
            chain.append(error)
            error = error.__cause__ or error.__context__
        return True


def _logger():
    logger = logging.getLogger(_LOGGER)
    if not any(isinstance(each, _DisconnectFilter) for each in logger.filters):
        logger.addFilter(_DisconnectFilter())
    return logger
