"""Exact real arithmetic of a run's discrete map, which certifies the decisions of runs in finite precision.
"""
