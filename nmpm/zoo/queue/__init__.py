"""Training of the whole zoo, used by `zoo/train.py`: the queue, its progress, and when a dataset's training stops."""
