"""Captures from a server."""

import functools
import hashlib
import http.server
import threading
import zipfile

import numpy as np
import pytest

from experiments import download as command
from nerfies_jax.capture import download, load, nerfies_format
from nerfies_jax.capture.errors import CaptureError
from tests import scenes


class Handler(http.server.SimpleHTTPRequestHandler):
    requests: list[str]

    def log_message(self, *words):
        pass

    def do_GET(self):
        self.requests.append(self.path)
        if self.path == "/cut.zip":  # ends before its length
            self.send_response(200)
            self.send_header("Content-Length", "1000")
            self.end_headers()
            self.wfile.write(b"PK")
            return
        super().do_GET()


@pytest.fixture
def server(tmp_path):
    """A server of the files of a folder, with the folder and what was requested."""
    folder = tmp_path / "served"
    folder.mkdir()
    requests = []
    handler = type("Handler", (Handler,), {"requests": requests})
    make = functools.partial(handler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), make) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{running.server_port}", requests
        running.shutdown()
        thread.join()


def archive(path, entries):
    with zipfile.ZipFile(path, "w") as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_capture_is_loaded_checked_and_found(server, tmp_path, capsys, monkeypatch):
    folder, address, requests = server
    nerfies_format.write(scenes.tiny_capture(), tmp_path / "made")
    files = [path for path in (tmp_path / "made").rglob("*") if path.is_file()]
    names = {f"set/one/{path.relative_to(tmp_path / 'made')}": path for path in files}
    entries = {name: path.read_bytes() for name, path in names.items()}
    digest = archive(folder / "set.zip", entries)
    source = download.Source(f"{address}/set.zip", "Apache-2.0", "here")
    monkeypatch.setitem(download.SOURCES, "ours", source)
    out = tmp_path / "captures" / "ours"
    command.main(["ours", str(out), "--sha256", digest.upper()])
    printed = capsys.readouterr().out
    assert digest in printed
    capture = out / "set" / "one"
    assert f"next: nerfies reconstruct {capture}" in printed
    images = load(capture).images
    np.testing.assert_array_equal(images, scenes.tiny_capture().images)
    command.main(["ours", str(out)])  # it is there
    assert requests == ["/set.zip"]
    with pytest.raises(CaptureError, match=f"had SHA-256 {digest}, but {'0' * 64}"):
        download.download("ours", out, "0" * 64)
    with pytest.raises(CaptureError, match=r"downloaded from .*choose another"):
        download.download(f"{address}/other.zip", out)


def test_what_is_damaged_or_unsafe_leaves_nothing(server, tmp_path):
    folder, address, _ = server
    archive(folder / "good.zip", {"a.txt": "a"})
    archive(folder / "out.zip", {"../../escaped.txt": "a"})
    link = zipfile.ZipInfo("link")
    link.external_attr = 0o120777 << 16
    archive(folder / "link.zip", {link: "/etc/passwd"})
    with zipfile.ZipFile(folder / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("zeros", bytes(40 << 20))
    (folder / "text.zip").write_text("no archive")
    out = tmp_path / "new"
    for name, words in {
        "cut": "ended after 2 of 1000 bytes",
        "out": "leads out of the folder",
        "link": "is a link",
        "bomb": "more than 20 times",
        "text": "not a readable zip archive",
        "missing": "cannot be downloaded .*404",
    }.items():
        with pytest.raises(CaptureError, match=words):
            download.download(f"{address}/{name}.zip", out)
    with pytest.raises(CaptureError, match="nothing was unpacked"):
        download.download(f"{address}/good.zip", out, "0" * 64)
    assert {path.name for path in tmp_path.iterdir()} == {"served"}
    with pytest.raises(CaptureError, match="did you mean nerfies-vrig"):
        download.download("nerfies-vrg", out)
