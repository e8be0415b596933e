"""Lightning callbacks of the command line's trainer, one per file."""
