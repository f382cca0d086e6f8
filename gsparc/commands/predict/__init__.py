"""`gsparc predict ckpt=FILE places=FILE`: see `command.py`."""
