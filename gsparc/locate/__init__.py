"""Where something was heard: positions from spectra, channels, powers and fingerprints."""
