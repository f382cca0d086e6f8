"""Where something was heard: see `locate`."""

from gsparc.apps.locate.locate import locate

__all__ = ["locate"]
