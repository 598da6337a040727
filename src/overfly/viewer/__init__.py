"""The map in the browser: live while mapping, finished with a time slider, and as a ground station."""
