"""Channels along a trajectory, as link simulators take them."""
