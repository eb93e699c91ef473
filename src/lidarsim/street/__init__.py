"""What stands in a simulated street, and how a drive leads through it."""

from lidarsim.street.streets import Street

__all__ = ["Street"]
