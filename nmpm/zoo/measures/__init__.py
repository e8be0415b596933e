"""What `nmpm zoo verify` and `nmpm zoo refresh --measure` measure of models."""
