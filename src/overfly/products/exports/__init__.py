"""The map for other programs: one small writer per format, each whole or not at all."""
