"""From a measured uplink to a place in three dimensions, where nobody noted where the user stood."""
