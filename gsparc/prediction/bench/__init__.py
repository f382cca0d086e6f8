"""Timings of kernels and queries as ratios to what the machine can do at best."""
