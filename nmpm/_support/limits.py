"""Limits on what files may ask for, checked before anything of that size is allocated or built."""

import re

FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
"""Names in files of others that become names of files: none is hidden or leads to another folder."""
TEXT_BYTES = 2**20
"""Size of a card, configuration or report."""
TEXT_DEPTH = 32
"""Nesting of lists and mappings in a YAML file."""
ALIASED = 10_000
"""Values in a YAML file that aliases repeat."""
DIGITS = 100
"""Length of a number in a YAML file; PyYAML's time to read one grows with the square of its length."""
NAME_LENGTH = 100
"""Length of the name of a zoo entry."""
WEIGHT_BYTES = 2**33
"""Size of a file of weights."""
INTEGER = 2**24
"""Largest integer in a model's recipe; some are exponents."""
CELLS = 2**24
"""Cells of a model's grid: 4096² or 256³."""
FRAMES = 2**12
"""Frames that one call of a model predicts."""
PARAMETERS = 10**9
"""Parameters of a network."""
LAYERS = 5_000
"""Modules of a network, and tensors of its parameters."""

EXPANSION = 200
"""Bytes that a dataset's file may unpack to, per stored byte; floats compress to a tenth at best."""
EXPANSION_FREE = 2**28
"""Bytes that any file may unpack to."""
METADATA_BYTES = 2**24
"""Size of a dataset's metadata.json; its nesting is limited as that of YAML."""
WHOLE = 2**31
"""Largest integer in a dataset's metadata, such as a type id."""
ARRAY_NAME = 200
"""Length of the name of an array in an archive."""
HDF5_OBJECTS = 2**16
"""Groups and datasets of an HDF5 file."""
HDF5_DEPTH = 8
"""Nesting of groups in an HDF5 file."""
PICKLE_BYTES = 2**31
"""Size of a pickle."""
PICKLE_STEPS = 1_000_000
"""Instructions of a pickle; an array of numbers takes about ten."""
PICKLE_ITEMS = 1_000_000
"""Objects in a pickle's content, one that occurs several times counted as often."""
PICKLE_DEPTH = 32
"""Nesting of containers in a pickle's content."""
RECORD_FIELDS = 500_000
"""Fields and integers of a TFRecord's record."""
MESSAGE_BYTES = 2**27
"""Size of a frame in a MessagePack stream."""
MESSAGE_CONTAINERS = 1_000
"""Lists and maps in a frame of a MessagePack stream."""
MESSAGE_ITEMS = 256
"""Items of a list or map in a MessagePack stream."""


def expansion_limit(stored: int) -> int:
    """Bytes that `stored` bytes may unpack to."""
    return EXPANSION_FREE + EXPANSION * stored
