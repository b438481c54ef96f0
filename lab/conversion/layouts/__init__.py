"""The layouts of networks that others published, so that their own checkpoints can be imported."""
