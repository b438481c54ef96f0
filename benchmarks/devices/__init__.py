"""What processors and GPUs make of the encoder."""
