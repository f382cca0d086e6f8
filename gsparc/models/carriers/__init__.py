"""Spectra of one array at several carriers: paths that all share,
a process over places and carriers.
"""
