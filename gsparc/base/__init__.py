"""What every room may use: errors, limits of settings, files, other processes."""
