"""Ways to damage files and plain data."""

import copy
import random
import re
from collections.abc import Iterator
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

Change = tuple[str, float, bytes]
"""What is done, where in the content (0 to 1), and with which bytes."""
KINDS = ("flip", "flip", "flip", "cut", "insert", "write", "repeat", "inflate", "quote", "double")
NUMBERS = (b"1000000000", b"-1", b"99999999999999999999", b"1e999", b"nan", b"4294967295", b"0", b"0x7fffffff", b"1.5")
BLOCKS = (
    b"\xff" * 4, b"\xff" * 8, bytes(4), b"\x80", b"\x7f\xff\xff\xff", b"9" * 400, b"[" * 200, b"nan", b"-1", b"1e999",
)  # fmt: skip
SCALARS = (
    st.none() | st.booleans() | st.integers() | st.integers(10**99, 10**120) | st.floats() | st.text(max_size=20)
    | st.sampled_from(["wall", "periodic", "nmpm.processors.UNet", "nmpm.processors.FNO", "stop", "goop"])
)  # fmt: skip
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
)
FUZZ = settings(
    max_examples=60, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)


def random_changes(rng: random.Random) -> list[Change]:
    """One to three changes."""
    return [
        (rng.choice(KINDS), rng.random(), rng.choice((rng.choice(BLOCKS), *(rng.randbytes(n) for n in (1, 4, 9)))))
        for _ in range(rng.randint(1, 3))
    ]


def damage(content: bytes, changes: list[Change]) -> bytes:
    """The content after bits are flipped, bytes inserted, overwritten or repeated, or its end cut off.

    In text a number becomes another one, quotes others, or a word, such as an attribute, or a line is there twice.
    """
    data = bytearray(content)
    for kind, share, extra in changes:
        at = int(share * len(data))
        if kind == "flip" and data:
            data[at % len(data)] ^= 1 << extra[0] % 8
        elif kind == "cut":
            del data[at:]
        elif kind == "insert":
            data[at:at] = extra
        elif kind == "write":
            data[at : at + len(extra)] = extra
        elif kind == "repeat":
            data[at:at] = data[at : at + 4 * len(extra)]
        elif kind == "inflate" and (number := re.search(rb"[-+]?\d[\d.]*", data[at:])):
            data[at + number.start() : at + number.end()] = NUMBERS[extra[0] % len(NUMBERS)]
        elif kind == "quote":
            data = data.replace(*((b'"', b"'") if extra[0] % 2 else (b'"', b"")))
        elif kind == "double" and (word := re.search((rb"\s\S+", rb"\n.*")[extra[0] % 2], data[at:])):
            data[at + word.end() : at + word.end()] = word[0]
    return bytes(data)


def places(plain: Any, path: tuple = ()) -> Iterator[tuple]:
    """The path to every key of nested mappings and lists."""
    items = plain.items() if isinstance(plain, dict) else enumerate(plain) if isinstance(plain, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def changed(plain: Any, place: tuple, value: Any) -> Any:
    """A copy of nested mappings and lists with another value at a place."""
    copied = inner = copy.deepcopy(plain)
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return copied
