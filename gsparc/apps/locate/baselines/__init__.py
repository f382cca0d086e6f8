"""Published ways from features to a place, behind one protocol."""
