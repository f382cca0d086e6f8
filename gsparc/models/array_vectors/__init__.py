"""Spectra of an array: phase retrieval and a vector GP where it is static,
image sources where it moves.
"""
