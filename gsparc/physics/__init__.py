"""Formulas and nothing else: waves, mirror planes, array response, spectra, lags, plane waves."""
