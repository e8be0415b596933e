"""A lock that lets one process at a time work in a folder."""

from __future__ import annotations

import fcntl
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from nmpm.errors import DataError

_log = logging.getLogger(__name__)


@contextmanager
def lock_folder(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Locks a folder against other processes and threads, waiting until it is free; creates the folder if missing.

    The lock is the operating system's, so that it is released however the process ends.

    Args:
        folder: The folder to lock.
        shared: Let in others that ask for a shared lock too.

    Raises:
        DataError: if the folder cannot be created or written.
    """
    with _open_lock(folder) as file:
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning("Another process works in %s; waiting for it to finish.", folder)
            fcntl.flock(file, kind)
        yield


def _open_lock(folder: Path) -> TextIO:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Over NFS a shared lock needs a readable file, an exclusive lock a writable one.
        return (folder / ".lock").open("a+")
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written ({error.strerror}). Correct the permissions, or choose another folder; the"
            " environment variable NMPM_HOME sets the folder of all that nmpm keeps."
        ) from error
