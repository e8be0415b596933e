"""`python -m nmpm`."""

import sys

from nmpm.cli import main

if __name__ == "__main__":
    sys.exit(main())
