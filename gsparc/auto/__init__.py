"""Which candidate or effect a site calls for, decided by left-out error."""
