"""Plumbing that knows nothing of particles: atomic files, plain data, specs, plugins, collectives, version."""
