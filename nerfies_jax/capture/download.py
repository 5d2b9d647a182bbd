"""Download captures that their authors publish, and check what arrived.

An archive is unpacked next to its target within a budget, and becomes visible only as a
whole. `download.json` in the folder keeps its address and SHA-256, and a repeated
download must have the same.
"""

import hashlib
import http.client
import pathlib
import shutil
import stat
import urllib.parse
import urllib.request
import zipfile
from typing import NamedTuple

from nerfies_jax.capture.errors import CaptureError
from nerfies_jax.capture.json_files import (
    AnyPath,
    new_folder,
    read_json,
    scratch_folder,
    write_json,
)
from nerfies_jax.capture.nearest import known_names
from nerfies_jax.runtime import events, stopping

RECORD = "download.json"
CHUNK_BYTES = 1 << 20
MOST_BYTES = 64 << 30  # of an archive
MOST_RATIO = 20.0  # of unpacked to packed bytes; images do not compress
MOST_FILES = 100_000
TIMEOUT_SECONDS = 60.0  # without a byte


class Source(NamedTuple):
    """A published archive of one or more captures."""

    address: str
    license: str
    paper: str


_HYPERNERF = "https://github.com/google/hypernerf/releases/download/v0.1"
_NERFIES = "https://github.com/google/nerfies/releases/download/0.1"
# Archives that are published under the license of their repository, which allows use
# and redistribution. docs/captures.md says where others are.
SOURCES = {
    "nerfies-vrig": Source(
        f"{_NERFIES}/nerfies-vrig-dataset-v0.1.zip",
        "Apache-2.0",
        "Nerfies (Park et al. 2021)",
    ),
    **{
        f"hypernerf-{name.replace('_', '-')}": Source(
            f"{_HYPERNERF}/{name}.zip", "Apache-2.0", "HyperNeRF (Park et al. 2021)"
        )
        for name in (
            *("vrig_3dprinter", "vrig_broom", "vrig_chicken", "vrig_peel-banana"),
            *("misc_americano", "misc_cross-hands", "misc_espresso"),
            *("misc_oven-mitts", "misc_split-cookie", "misc_tamping"),
        )
    },
}


class Downloaded(NamedTuple):
    """An unpacked archive."""

    folder: pathlib.Path
    captures: list[pathlib.Path]  # folders that hold one, at most
    sha256: str
    bytes: int


def _source_of(name: str) -> str:
    """Return the address of a published capture."""
    if name in SOURCES:
        return SOURCES[name].address
    if urllib.parse.urlsplit(name).scheme in ("http", "https"):
        return name
    raise CaptureError(
        f"{name}: neither an http(s) address nor a known capture; "
        + known_names(name, SOURCES)
    )


def download(name: str, folder: AnyPath, sha256: str | None = None) -> Downloaded:
    """Download an archive and unpack it to a new folder.

    Args:
      name: Name of a source, or an http(s) address of a zip archive.
      folder: Folder to make. If it is there from the same address, nothing is loaded.
      sha256: SHA-256 that the archive must have, in hexadecimal digits.

    Returns:
      The folder, with the captures in it.

    Raises:
      CaptureError: If the archive cannot be loaded, is not what was expected or would
        unpack to unsafe or too many files, or if the folder holds something else.
    """
    address, folder = _source_of(name), pathlib.Path(folder)
    if folder.exists() and any(folder.iterdir()):
        return _already(folder, address, sha256)
    with scratch_folder(folder.parent / f"{folder.name}.zip") as scratch:
        archive = scratch / "archive.zip"
        digest, size = _fetch(address, archive)
        if sha256 is not None and digest != sha256.lower():
            raise CaptureError(
                f"{address}: its SHA-256 is {digest}, but {sha256.lower()} was "
                "expected; the file was changed or damaged, so nothing was unpacked"
            )
        with new_folder(folder) as partial:
            _unpack(address, archive, partial)
            about = {"address": address, "sha256": digest, "bytes": size}
            write_json(partial / RECORD, about)
    return Downloaded(folder, _captures_in(folder), digest, size)


def _captures_in(folder: pathlib.Path) -> list[pathlib.Path]:
    """List the folders that hold a capture of a format that is read."""
    from nerfies_jax.capture import formats

    folders: list[pathlib.Path] = []
    level = [folder]
    for _ in range(4):
        below = []
        for each in level:
            if any(form.recognize(each) for form in formats.FORMATS):
                folders.append(each)
            else:
                below += sorted(path for path in each.iterdir() if path.is_dir())
        level = below
    return folders


def _already(folder, address, sha256):
    record = folder / RECORD
    if not record.is_file():
        raise CaptureError(f"{folder}: already there; choose another folder")
    about = read_json(record, dict[str, str | int])
    if about.get("address") != address:
        raise CaptureError(
            f"{folder}: downloaded from {about.get('address')}; choose another folder"
        )
    digest = str(about.get("sha256"))
    if sha256 is not None and digest != sha256.lower():
        raise CaptureError(
            f"{folder}: its archive had SHA-256 {digest}, but {sha256.lower()} was "
            "expected; choose another folder to download it again"
        )
    return Downloaded(folder, _captures_in(folder), digest, int(about.get("bytes", 0)))


def _fetch(address, path):
    """Load a file. Return its SHA-256 and size."""
    digest, size = hashlib.sha256(), 0
    request = urllib.request.Request(address, headers={"User-Agent": "nerfies-jax"})
    try:
        with (
            urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS) as answer,
            path.open("wb") as file,
        ):
            expected_size = int(answer.headers.get("Content-Length") or 0)
            _check_room(address, path, expected_size)
            total = max(1, -(-expected_size // CHUNK_BYTES)) if expected_size else None
            with events.stage("downloading", total) as stage:
                while chunk := answer.read(CHUNK_BYTES):
                    stopping.check()
                    size += len(chunk)
                    if size > MOST_BYTES:
                        raise CaptureError(f"{address}: more than {MOST_BYTES} bytes")
                    digest.update(chunk)
                    file.write(chunk)
                    stage.advance()
    except CaptureError:
        raise
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise CaptureError(f"{address}: cannot be downloaded ({error})") from error
    if expected_size and size != expected_size:
        raise CaptureError(
            f"{address}: the connection ended after {size} of {expected_size} bytes; "
            "try again"
        )
    return digest.hexdigest(), size


def _check_room(address, path, expected_size):
    free = shutil.disk_usage(path.parent).free
    if 2 * expected_size > free:
        raise CaptureError(
            f"{address}: {expected_size / 1e9:.1f} GB to load and as much to unpack, "
            f"but {free / 1e9:.1f} GB are free; choose a folder on another disk"
        )


def _unpack(address, archive, folder):
    """Unpack regular files that lie inside the folder, within the budget."""
    root = folder.resolve()
    most = MOST_RATIO * archive.stat().st_size + CHUNK_BYTES
    try:
        with zipfile.ZipFile(archive) as zip_file:
            members = [each for each in zip_file.infolist() if not each.is_dir()]
            if len(members) > MOST_FILES or sum(x.file_size for x in members) > most:
                raise CaptureError(
                    f"{address}: its {len(members)} files would take more than "
                    f"{MOST_RATIO:g} times the archive's size, so it is not unpacked"
                )
            remaining = int(most)
            for member in members:
                stopping.check()
                target = (root / member.filename).resolve()
                kind = stat.S_IFMT(member.external_attr >> 16)
                inside = target.is_relative_to(root) and "\\" not in member.filename
                if not inside or kind not in (0, stat.S_IFREG):
                    raise CaptureError(
                        f"{address}: its entry {member.filename!r} is a link or leads "
                        "out of the folder, so it is not unpacked"
                    )
                target.parent.mkdir(parents=True, exist_ok=True)
                with zip_file.open(member) as source, target.open("xb") as file:
                    while chunk := source.read(CHUNK_BYTES):
                        remaining -= len(chunk)
                        if remaining < 0:
                            raise CaptureError(
                                f"{address}: it holds more than it says, so it is not "
                                "unpacked"
                            )
                        file.write(chunk)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError) as error:
        raise CaptureError(f"{address}: not a readable zip archive ({error})") from None
