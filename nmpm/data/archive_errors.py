"""Exceptions that reading a damaged archive raises in zipfile, zlib and NumPy."""

from __future__ import annotations

import struct
import tokenize
import zipfile
import zlib

ZIP_ERRORS: tuple[type[Exception], ...] = (
    OSError,
    EOFError,
    RuntimeError,  # encrypted, or compressed by an unknown method
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)

NPZ_ERRORS: tuple[type[Exception], ...] = (
    *ZIP_ERRORS,
    KeyError,  # a listed array is missing
    ValueError,
    TypeError,
    MemoryError,  # too large, or a header with too many brackets
    tokenize.TokenError,  # from an array's header, which is a Python literal
)
