"""Multipath models with carrier phase: image sources, diffraction, clutter and uplink extrapolation."""
