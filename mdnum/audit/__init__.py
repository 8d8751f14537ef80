"""Audit of any ASE calculator: is it safe to run dynamics with the calculator, and to differentiate it?"""
