"""The back end: pose graphs, their optimisers, covariances and files. Knows no images, no SQL, no command
line.
"""
