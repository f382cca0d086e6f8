"""Channels along a trajectory, as channel emulators and link simulators take them."""
