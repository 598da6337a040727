"""Poses, cameras, levelling and geodesy. Imports nothing of Overfly but its errors and types."""
