"""The training of the whole zoo: what to train, how far it is, and when a dataset stops. Used by `zoo/train.py`."""
