"""Breaking valid files: their bytes, their numbers, their JSON, their size."""

from __future__ import annotations

import json
import re
import struct
import zlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from random import Random

__all__ = ["MOST_BYTES", "mutate", "png_chunk", "sealed_png"]

MOST_BYTES = 1 << 20
"""Mutated files are at most about as large."""

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_NUMBERS = (
    *(
        b"0",
        b"-0",
        b"-1",
        b"1.5",
        b"1e400",
        b"-1e400",
        b"1e308",
        b"nan",
        b"inf",
        b"1_0",
        b"",
        b"+3",
    ),
    *(
        b"0x10",
        b"1e-320",
        b"99999999999999999999",
        b"9" * 400,
        b"9" * 5000,
        b"2147483648",
        b"\xd9\xa3",
    ),
    *(b"4294967296", b"255", b"65536", b"true", b'"7"', b"\xb2", b"1.0", b"1 2", b"[1]"),
)
_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1.5, 1e308, float("nan"), float("inf"), 10**400, 2**31, 2**63),
    *("", "x", "7", "\ud800", "<UNK>", "wall_1", "a" * 5000, [], [[]], {}, {"a": 1}, [1, 2], ["7"]),
)
_FIELDS = (0, 1, 2, 7, 8, 16, 255, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_DEPTH = 100_000


def mutate(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """A file with one to four faults.

    Args:
        content: The file.
        rng: What is done, and where.
        others: Files of the same kind, to splice with.
    """
    if rng.random() < 0.3:
        content = _mutate_json(content, rng) or content
    for _ in range(rng.randint(1, 4)):
        content = rng.choice(_MUTATIONS)(content, rng, others)
    return content[:MOST_BYTES]


def _place(content: bytes, rng: Random) -> int:
    # Half of them at the beginning: headers are short, pixels are many.
    return rng.randint(0, min(len(content), 64) if rng.random() < 0.5 else len(content))


def _flip(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8))):
        if changed:
            changed[_place(content, rng) % len(changed)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    place, value = _place(content, rng), rng.choice(_FIELDS)
    kind = rng.choice((">I", "<I", ">H", "<H", "B"))
    field = struct.pack(kind, value % (1 << 8 * struct.calcsize(kind)))
    return content[:place] + field + content[place + len(field) :]


def _truncate(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    return content[: _place(content, rng)]


def _leave_out(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    place = _place(content, rng)
    return content[:place] + content[place + rng.choice((1, 2, 4, 16, 100)) :]


def _insert(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    place = _place(content, rng)
    new = rng.choice(
        (rng.randbytes(rng.randint(1, 16)), b"\n", b" ", b"\0", b"#", b"\x1c", b"\xa0")
    )
    return content[:place] + new + content[place:]


def _repeat(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    place = _place(content, rng)
    piece = content[place : place + rng.choice((1, 2, 4, 16, 64, 1024))]
    often = rng.choice((2, 3, 10, 1000, 100_000, 500_000))
    often = min(often, MOST_BYTES // max(1, len(piece)))
    return content[:place] + piece * often + content[place + len(piece) :]


def _splice(content: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    return content[: _place(content, rng)] + other[_place(other, rng) :]


def _renumber(content: bytes, rng: Random, _others: Sequence[bytes]) -> bytes:
    found = list(_NUMBER.finditer(content[: 1 << 16]))
    if not found:
        return content
    start, end = rng.choice(found).span()
    return content[:start] + rng.choice(_NUMBERS) + content[end:]


_MUTATIONS: tuple[Callable[[bytes, Random, Sequence[bytes]], bytes], ...] = (
    *(_flip, _overwrite, _truncate, _leave_out, _insert, _repeat, _splice, _renumber, _renumber),
)


def _mutate_json(content: bytes, rng: Random) -> bytes | None:
    """The same JSON with another value somewhere; None where it is none."""
    try:
        whole = [json.loads(content)]
    except (ValueError, RecursionError):
        return None
    if rng.random() < 0.05:
        return rng.choice((b"[", b'{"a":')) * _DEPTH
    holder: Any = whole
    key: Any = 0
    while isinstance(holder[key], (dict, list)) and holder[key] and rng.random() < 0.8:
        holder = holder[key]
        key = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    if rng.random() < 0.2 and holder is not whole:
        del holder[key]
    else:
        holder[key] = rng.choice((*_VALUES, [holder[key]], {"a": holder[key]}))
    try:
        return json.dumps(whole[0]).encode()
    except ValueError:  # 10**400 has too many digits to be written
        return None


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG file with its length and checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def sealed_png(content: bytes) -> bytes:
    """A PNG file whose checksums are right: decoders look at what is in the chunks then."""
    if not content.startswith(b"\x89PNG"):
        return content
    start, sealed = 8, bytearray(content)
    while start + 12 <= len(sealed):
        size = int.from_bytes(sealed[start : start + 4], "big")
        end = start + 8 + size
        if end + 4 > len(sealed):
            break
        sealed[end : end + 4] = struct.pack(">I", zlib.crc32(sealed[start + 4 : end]))
        start = end + 4
    return bytes(sealed)
