"""Bags, videos and folders of pictures: reading them whole, and damaged."""
