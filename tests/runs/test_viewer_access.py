"""The viewer answers its own page alone, and does not complain of who leaves."""

import http.client
import logging
import socket
import time

import pytest

from nerfies_jax.runs import viewer_access

viser = pytest.importorskip("viser")
client = pytest.importorskip("websockets.sync.client")


@pytest.fixture(scope="module")
def port():
    with viewer_access.guarded():
        server = viser.ViserServer("127.0.0.1", 8280, verbose=False)
    yield server.get_port()
    server.stop()


def page_status(port, **headers):
    """The status that the page is answered with."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    try:
        connection.putrequest("GET", "/", skip_host=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        text = response.read()
        # 403 says what to do, and shows nothing of the page.
        assert (b"Refused" in text) == (response.status == 403)
        return response.status
    finally:
        connection.close()


def test_the_page_is_served_under_its_own_names_alone(port):
    assert page_status(port, Host=f"127.0.0.1:{port}") == 200
    assert page_status(port, Host=f"LocalHost:{port}") == 200
    own = f"http://127.0.0.1:{port}"
    assert page_status(port, Host=f"127.0.0.1:{port}", Origin=own) == 200
    # A name of somebody's own that resolves to this machine: DNS rebinding.
    assert page_status(port, Host=f"attacker.example:{port}") == 403
    assert page_status(port, Host=f"127.0.0.1.attacker.example:{port}") == 403
    assert page_status(port, Host="127.0.0.1:1") == 403
    assert page_status(port, Host="127.0.0.1") == 403
    assert page_status(port) == 403
    for origin in ("http://attacker.example", "null", f"https://127.0.0.1:{port}"):
        assert page_status(port, Host=f"127.0.0.1:{port}", Origin=origin) == 403


def handshake(port, name="127.0.0.1", **headers):
    """Open a websocket as a page does; raises InvalidStatus where it is refused."""
    return client.connect(
        f"ws://{name}:{port}",
        sock=socket.create_connection(("127.0.0.1", port)),
        max_size=None,
        subprotocols=[f"viser-v{viser.__version__}"],
        **headers,
    )


def test_a_websocket_of_another_site_is_refused(port):
    from websockets.exceptions import InvalidStatus

    for origin in (f"http://127.0.0.1:{port}", f"http://localhost:{port}", None):
        with handshake(port, origin=origin) as connection:
            assert connection.recv(timeout=120)
    for refused in (
        {"origin": "http://attacker.example"},
        {"origin": f"http://attacker.example:{port}"},
        {"origin": "null"},
        {"origin": f"http://127.0.0.1:{port + 1}"},
        {"name": "attacker.example"},
        {"name": "attacker.example", "origin": f"http://attacker.example:{port}"},
    ):
        with pytest.raises(InvalidStatus) as status:
            handshake(port, **refused)
        assert status.value.response.status_code == 403


def test_connections_that_end_early_log_no_warning(port, caplog):
    # viser filters all failed handshakes out, but only after the first good one.
    logger = viewer_access._logger()
    theirs = [f for f in logger.filters if type(f).__module__.startswith("viser")]
    for each in theirs:
        logger.removeFilter(each)
    with caplog.at_level(logging.WARNING):
        # A browser opens some in advance and may never use them.
        socket.create_connection(("127.0.0.1", port)).close()
        half = socket.create_connection(("127.0.0.1", port))
        half.sendall(b"GET / HTTP/1.1\r\nHost: 127")
        half.close()
        # A tab that is closed sends no farewell.
        tab = handshake(port)
        tab.recv(timeout=120)
        tab.socket.shutdown(socket.SHUT_RDWR)
        tab.socket.close()
        page_status(port, Host="attacker.example")
        time.sleep(0.5)
    assert [record.getMessage() for record in caplog.records] == []


def test_errors_of_the_server_itself_are_logged(caplog):
    logger = viewer_access._logger()
    with caplog.at_level(logging.WARNING):
        try:
            raise ValueError("a fault of ours")
        except ValueError:
            logger.error("connection handler failed", exc_info=True)
        try:
            raise RuntimeError("opening") from EOFError("left")
        except RuntimeError:
            logger.error("opening handshake failed", exc_info=True)
    assert [record.getMessage() for record in caplog.records] == [
        "connection handler failed"
    ]
