"""Exact real arithmetic of a run's discrete map, to certify the decisions of finite-precision runs."""
