"""Plumbing that knows nothing of particles: atomic files, plain data, machines, threads; and the version."""

__version__ = "0.1.0"
