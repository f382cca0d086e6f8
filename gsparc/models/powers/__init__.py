"""Received powers as a field: Gaussians that shadow the path, fringes of coherent sources,
and a process.
"""
