"""Plane-wave sources of an uplink snapshot, extrapolated to the downlink's band."""
