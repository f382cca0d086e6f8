"""Whether a confidence can be trusted: what it costs to accept, and thresholds that keep a promise."""
