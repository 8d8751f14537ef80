"""Sensitivity studies: which choices move which results, by how many errors, and which setting is enough.

design      choices and their values, and the points that they make
points      a folder for each point, named by what was asked: none lost, none computed twice
engines     who computes points: processes here, or any executor
measures    what is read from a point, with its statistical error
statistics  means over seeds, differences in units of their error, and what could have been seen
advice      the cheapest setting within a tolerance of the converged one
"""
