"""The only users of python-can at run time: ports on buses and the threads that empty them."""

from skinnode.transport.frame import Frame
from skinnode.transport.port import CanPort
from skinnode.transport.receiver import Intake, Receiver

__all__ = ["CanPort", "Frame", "Intake", "Receiver"]
