"""Several stations, moving ends, degrees: from the arrays of a file to a row for each link."""
