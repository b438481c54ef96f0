"""Frames: from the bytes of a file to pixels, masks, the input of a network; folders of frames as traverses."""
