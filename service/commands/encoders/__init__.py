"""Encoders as commands use them: those installed, and pictures to calibrate them on."""
