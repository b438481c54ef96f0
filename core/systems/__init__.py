"""The place recognition systems that are compared: this project's own and those of the thesis."""
