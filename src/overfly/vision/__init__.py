"""From pictures to poses: features, matching, the two-point solver, pair search, refinement, stereo. No I/O."""
