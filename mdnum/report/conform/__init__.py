"""The page of a neighbor list that went through the conformance suite."""
