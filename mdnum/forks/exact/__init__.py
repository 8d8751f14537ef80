"""Certified decisions: a run against the same map in exact real arithmetic."""
