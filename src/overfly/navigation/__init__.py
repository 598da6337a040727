"""Flying to places of the map, and keeping there."""
