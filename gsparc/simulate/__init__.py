"""Simulators whose ground truth is known."""
