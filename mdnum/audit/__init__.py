"""Audit of any ASE calculator: is it safe for dynamics and for gradients?"""
