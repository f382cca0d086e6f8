"""Fixtures of files and arrays that several rooms share."""

from file_fixtures import csi_arrays, refused, rfid_folder, write  # noqa: F401
