"""Poses, cameras, levelling and geodesy. Imports nothing from the rest of Overfly but its errors and types."""
