"""Public data: which sets there are, from where, and how one is fetched."""
