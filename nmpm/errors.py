"""Errors that a user can mend: the message names what is wrong, where, and how to put it right.

The command line prints such an error without a traceback; everything else is a bug and keeps its traceback.
"""


class NmpmError(Exception):
    """Base of every error that `nmpm` raises on purpose."""

    exit_status = 1
    """Of the command that it ends."""


class DataError(NmpmError, ValueError):
    """A file, trajectory or array does not hold what it should."""


class ConfigError(NmpmError, ValueError):
    """A configuration asks for something that cannot be."""


class UnstableError(ConfigError):
    """A simulation does not stay stable with the given settings."""


class ZooError(NmpmError, LookupError):
    """A model that the zoo does not hold, or holds damaged."""
