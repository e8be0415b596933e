"""The engine of tensor operations: every feature, device and precision, with gradients; traced for exports."""
