"""The sources heard in a fresh uplink: the channel of the other half of the band follows from them."""
