"""Everything that draws: panels, plans, spectra, the report's page."""
