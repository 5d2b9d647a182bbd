"""Random damage to the bytes of a file, of the kinds that parsers get wrong."""

import gzip
import io
import random
import re
import zipfile
import zlib

NUMBERS = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
TOKENS = re.compile(rb'"[^"\n]{0,80}"|-?\d[\d.eE+-]*|\[|\]|\{|\}|true|false|null')
TEXTS = (
    *(b"0", b"-1", b"1", b"1e308", b"-1e308", b"1e400", b"1e-320", b"1e38", b"1e30"),
    *(b"NaN", b"Infinity", b"nan", b"null", b"true", b'"x"', b"[]", b"{}", b"-0.0"),
    *(b"2147483648", b"4294967295", b"9223372036854775808", b"9" * 40, b"9" * 5000),
    *(b'""', b'"../../x"', b'"/etc/passwd"', b'"a\\u0000b"', b'"' + b"a" * 5000 + b'"'),
    *(
        b"[" * 2000,
        b'{"a":' * 2000,
        b'"\\ud800"',
        b"\xff\xfe",
        b"0.5",
        b"1e-30",
        b"[[]]",
    ),
)
INTEGERS = (
    0,
    1,
    2,
    127,
    128,
    255,
    2**15,
    2**16 - 1,
    2**24,
    2**31 - 1,
    2**31,
    2**32 - 1,
)
LONG = (0, 1, 2**31, 2**32, 2**40, 2**53, 2**63 - 1, 2**63, 2**64 - 1)


def mutate(data: bytes, name: str, draw: random.Random) -> bytes:
    """Damage the content of a file.

    Args:
      data: The content.
      name: The file's name. What is packed in an archive is damaged inside it half of
        the time, and packed again.
      draw: Source of randomness.

    Returns:
      The damaged content.
    """
    inside = draw.random() < 0.5
    if inside and data[:4] == b"PK\x03\x04":
        return _in_zip(data, draw)
    if inside and data[:2] == b"\x1f\x8b":
        return _in_gzip(data, draw)
    if inside and data[:8] == b"\x89PNG\r\n\x1a\n":
        return _in_png(data, draw)
    text = name.endswith((".json", ".jsonl", ".txt"))
    kinds = _OF_TEXT if text else _OF_BYTES
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        data = draw.choice(kinds)(data, draw)
    return data


def _flip(data, draw):
    if not data:
        return data
    out = bytearray(data)
    for _ in range(draw.choice((1, 2, 8))):
        out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    return bytes(out)


def _set_integer(data, draw):
    """Somewhere near the start, where headers are, more often than not."""
    size = draw.choice((1, 2, 4, 8))
    if len(data) < size:
        return data
    end = min(len(data), draw.choice((64, 512, len(data)))) - size
    at = draw.randint(0, max(end, 0))
    value = draw.choice(LONG if size == 8 else INTEGERS) % 2 ** (8 * size)
    int_bytes = value.to_bytes(size, draw.choice(("little", "big")))
    return data[:at] + int_bytes + data[at + size :]


def _cut(data, draw):
    return data[: draw.randrange(len(data) + 1)]


def _remove(data, draw):
    at = draw.randrange(len(data) + 1)
    return data[:at] + data[at + draw.choice((1, 4, 100)) :]


def _repeat(data, draw):
    at = draw.randrange(len(data) + 1)
    part = data[at : at + draw.choice((1, 8, 200))]
    return data[:at] + part * draw.choice((2, 20)) + data[at:]


def _noise(data, draw):
    at, size = draw.randrange(len(data) + 1), draw.choice((1, 4, 32))
    end = at + size * draw.randint(0, 1)
    return data[:at] + draw.randbytes(size) + data[end:]


def _replace_token(data, draw):
    places = [each.span() for each in TOKENS.finditer(data)]
    if not places:
        return _noise(data, draw)
    start, end = draw.choice(places)
    return data[:start] + draw.choice(TEXTS) + data[end:]


def _replace_number(data, draw):
    places = [each.span() for each in NUMBERS.finditer(data)]
    if not places:
        return _noise(data, draw)
    start, end = draw.choice(places)
    return data[:start] + draw.choice(TEXTS[:21]) + data[end:]


def _remove_token(data, draw):
    places = [each.span() for each in TOKENS.finditer(data)]
    if not places:
        return _cut(data, draw)
    start, end = draw.choice(places)
    return data[:start] + data[end:]


_OF_BYTES = (
    *(_flip, _flip, _set_integer, _set_integer, _cut, _remove, _repeat, _noise),
    _replace_number,  # headers of .ply and .npy are text
)
_OF_TEXT = (
    *(_replace_token, _replace_token, _replace_number, _remove_token, _flip, _cut),
    *(_remove, _repeat, _noise),
)


def _in_zip(data, draw):
    """Damage one member of an archive, whose checksums are then right again."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(data)) as archive,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as out,
    ):
        members = archive.namelist()
        hit = draw.choice(members)
        for member in members:
            content = archive.read(member)
            if member == hit:
                content = mutate(content, _kind(content), draw)
            out.writestr(member, content)
    return buffer.getvalue()


def _kind(content):
    return "a.json" if content[:1] == b"{" else "a.bin"


def _in_gzip(data, draw):
    return gzip.compress(mutate(gzip.decompress(data), "a.bin", draw), 1)


def _in_png(data, draw):
    """Damage one chunk, whose checksum is then right again."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append([data[at + 4 : at + 8], data[at + 8 : at + 8 + size]])
        at += 12 + size
    if not chunks:
        return data
    hit = draw.choice(chunks)
    hit[1] = draw.choice(_OF_BYTES)(hit[1], draw)
    out = data[:8]
    for kind, content in chunks:
        crc = zlib.crc32(kind + content).to_bytes(4, "big")
        out += len(content).to_bytes(4, "big") + kind + content + crc
    return out
