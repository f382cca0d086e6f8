"""Spectra of a moving array: triangulated sources, their powers over places,
and a residual process.
"""
