"""Pages on anybody's trajectory: the flips of one, and where two part."""
