"""Received powers of many ends in one model: what is of the site is shared,
what is of an end is its own.
"""
