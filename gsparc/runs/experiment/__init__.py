"""Variants of a model and methods under the same data, splits and clock: stored cells, tables,
figures.
"""
