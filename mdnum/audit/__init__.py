"""Audit of any ASE calculator: is it safe to run dynamics with it, and to differentiate it?"""
