"""The maps, the encoders, the queue in front of them and the locks."""
