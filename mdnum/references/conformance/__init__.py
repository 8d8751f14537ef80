"""A conformance suite for neighbor lists: anybody's pair search against an exact oracle."""
