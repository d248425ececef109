"""Breaking valid files: their bytes, their numbers, their JSON, their length."""

from __future__ import annotations

import json
import re
import struct
import zlib
from random import Random
from typing import Any

_MOST_BYTES = 1 << 20
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_NUMBERS = b"0|-0|-1|1.5|1e400|1e308|nan|inf|1_0||0x10|2147483648|65536|true|1 2".split(b"|")
_NUMBERS += [b"9" * 400, b"9" * 5000, b"\xd9\xa3"]
_VALUES: list[Any] = [None, True, -1, 1.5, 1e308, float("nan"), 10**400, 2**63, "", "x", "\ud800"]
_VALUES += ["a" * 5000, [], [[]], {}, {"a": 1}, ["7"]]
_FIELDS = (0, 1, 255, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def mutate(content: bytes, rng: Random) -> bytes:
    """A file with one to four faults."""
    if rng.random() < 0.3:
        content = _mutate_json(content, rng)
    for _ in range(rng.randint(1, 4)):
        content = _mutate_bytes(content, rng)
    return content[:_MOST_BYTES]


def _mutate_bytes(content: bytes, rng: Random) -> bytes:
    # Half of the faults at the beginning: headers are short, pixels are many.
    place = rng.randint(0, min(len(content), 64) if rng.random() < 0.5 else len(content))
    before, after = content[:place], content[place:]
    kind = rng.choice(("flip", "field", "cut", "drop", "insert", "repeat", "number", "number"))
    if kind == "flip" and after:
        return before + bytes([after[0] ^ 1 << rng.randrange(8)]) + after[1:]
    if kind == "field":
        field = struct.pack(rng.choice((">I", "<I")), rng.choice(_FIELDS))
        return before + field + after[4:]
    if kind == "drop":
        return before + after[rng.choice((1, 2, 4, 16, 100)) :]
    if kind == "insert":
        return before + rng.choice((rng.randbytes(8), b"\n", b"\0", b"#", b"\xa0")) + after
    if kind == "repeat":
        piece = after[: rng.choice((1, 4, 16, 1024))]
        return before + piece * rng.choice((2, 10, 1000, _MOST_BYTES // 1024)) + after
    if kind == "number" and (found := list(_NUMBER.finditer(content[: 1 << 16]))):
        start, end = rng.choice(found).span()
        return content[:start] + rng.choice(_NUMBERS) + content[end:]
    return before


def _mutate_json(content: bytes, rng: Random) -> bytes:
    """The same JSON with another value somewhere."""
    try:
        whole = [json.loads(content)]
    except ValueError:
        return content
    if rng.random() < 0.05:
        return rng.choice((b"[", b'{"a":')) * 100_000
    holder: Any = whole
    key: Any = 0
    while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() < 0.8:
        holder = holder[key]
        key = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    if rng.random() < 0.2 and holder is not whole:
        del holder[key]
    else:
        holder[key] = rng.choice((*_VALUES, [holder[key]]))
    try:
        return json.dumps(whole[0]).encode()
    except ValueError:  # 10**400 has too many digits to be written
        return content


def sealed_png(content: bytes) -> bytes:
    """A PNG file whose checksums are right: decoders look at what is in the chunks then."""
    start, sealed = 8, bytearray(content)
    while content.startswith(b"\x89PNG") and start + 12 <= len(sealed):
        end = start + 8 + int.from_bytes(sealed[start : start + 4], "big")
        if end + 4 > len(sealed):
            break
        sealed[end : end + 4] = struct.pack(">I", zlib.crc32(sealed[start + 4 : end]))
        start = end + 4
    return bytes(sealed)
