"""Learned positions: a measured uplink to three coordinates, where no user positions were recorded."""
