"""Frames: decoding files to pixels, masks, the input of a network, and folders of frames as traverses."""
