"""Sensitivity studies: which numerical choices affect which results, and which setting is accurate enough.

design      choices and their values, and the points that they make
points      storage of points, in one folder each, so that none is lost or computed twice
engines     execution of points, by local processes or any executor
measures    quantities that are derived from a point, with statistical errors
statistics  means over seeds, differences in units of their error, and detection limits
advice      the cheapest setting that agrees with the converged one within a tolerance
"""
