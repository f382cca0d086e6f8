"""Spectra of a moving array: sources found where bearings cross, seen from wherever the receiver stands."""
