"""Sensitivity studies: which numerical choices affect which results, and which setting is accurate enough.

design      choices with their values, and the points (settings with seeds) to run
points      storage of the results of points, with one folder for each point
engines     execution of points by local processes or another executor
measures    quantities that are derived from a point, with statistical errors
statistics  means over seeds, differences with errors, and detection limits
advice      the cheapest setting that agrees with converged results within a tolerance
"""
