"""Places seen before: which nodes may show the same ground, whether they do, and what that is worth to the
map."""
