"""How good an emulator is: metrics, trivial predictors beside it, and the stress battery."""
