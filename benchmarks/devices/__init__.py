"""The encoder on processors and GPUs."""
