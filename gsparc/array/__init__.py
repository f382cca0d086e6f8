"""Spectra of a static array while the transmitter moves: recovery, fields through the array, queries."""
