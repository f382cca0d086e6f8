"""Coherent effects when the receiver moves: sources whose position explains phase, amplitude and delay."""
