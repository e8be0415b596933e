"""Batches for training and evaluation: where trajectories come from, which windows are drawn, how they are padded."""
