"""A trained field as the file that `ops/csrc/field` answers from, without Python."""
