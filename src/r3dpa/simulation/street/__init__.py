"""What stands in a simulated street, and how a drive leads through it."""

from r3dpa.simulation.street.streets import Street

__all__ = ["Street"]
