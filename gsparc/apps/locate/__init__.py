"""Where something was heard: see `locate`."""

from gsparc.apps.locate.locator import locate

__all__ = ["locate"]
