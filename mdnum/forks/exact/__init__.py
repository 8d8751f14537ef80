"""Exact arithmetic for the time steps of a run, to certify the decisions of finite-precision runs."""
