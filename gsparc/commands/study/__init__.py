"""Variants of one model and baselines under the same data, splits and clock."""
