"""GSpaRC: Gaussian splatting for radio. See ARCHITECTURE.md for a map."""
