"""Exact arithmetic for time steps, to certify decisions in finite precision."""
