"""The page of an audited calculator."""
