"""Files of published campaigns, read as the arrays of docs/own-data.md or as measurements."""
