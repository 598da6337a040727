"""From pictures to poses: features, matching, two-point solver, pair search, refinement, stereo. No I/O."""
