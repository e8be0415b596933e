"""Recorded trajectories: their files, the scenes they show, and the windows a model learns from."""
