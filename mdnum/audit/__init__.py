"""Anybody's potential: is this ASE calculator safe to run and to differentiate?"""
