"""Trajectories: file formats, metadata, conversion, simulation of embedded datasets, and batches for Lightning."""
