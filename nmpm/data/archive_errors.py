"""What reading a damaged archive raises: zipfile, zlib and NumPy each have errors of their own."""

from __future__ import annotations

import struct
import tokenize
import zipfile
import zlib

ZIP_ERRORS: tuple[type[Exception], ...] = (
    OSError,
    EOFError,
    RuntimeError,  # it says that it is encrypted, or packed in a way that Python does not know
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)

NPZ_ERRORS: tuple[type[Exception], ...] = (
    *ZIP_ERRORS,
    KeyError,  # the archive lists other arrays than it has
    ValueError,
    tokenize.TokenError,  # of an array's header, which is Python's notation
)
