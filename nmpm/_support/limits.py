"""Limits on what files may ask for, checked before anything of that size is allocated or built."""

TEXT_BYTES = 2**20
"""Size of a card, configuration or report."""
TEXT_DEPTH = 32
"""Nesting of lists and mappings in a YAML file."""
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
