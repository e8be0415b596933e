"""Writes trajectories for other programs."""
