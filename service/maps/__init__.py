"""Maps: their settings, cameras, calibration, exports and imports."""
