"""What a flight leaves for people and for other programs: mosaic, elevation, charts, report."""
