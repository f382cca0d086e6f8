"""Multipath models with carrier phase: image sources, clutter and uplink extrapolation."""
